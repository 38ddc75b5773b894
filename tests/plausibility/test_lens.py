"""A lens model that gives some pixels no viewing ray is named, and not taken for clutter."""

from dataclasses import replace
from pathlib import Path

from tofcorr.data.recording import Recording
from tofcorr.pixels.dataset import Dataset
from tofcorr.plausibility.examine import examine


def _lens_findings(clean: Path, k1: float) -> list[str]:
    recording = Recording.open(clean)
    camera = replace(recording.camera, distortion=(k1, 0.0, 0.0, 0.0))
    found = examine(Dataset((replace(recording, camera=camera),)))
    return [one.sentence for one in found.findings if one.check == "lens"]


def test_corners_that_the_lens_model_does_not_reach_are_named(clean: Path) -> None:
    # r - 0.9 r^3 is 0.406 at most, in focal lengths; the corner of the image is at 0.45.
    assert _lens_findings(clean, -0.1) == []
    (sentence,) = _lens_findings(clean, -0.9)
    assert "of the pixels have no viewing ray" in sentence
