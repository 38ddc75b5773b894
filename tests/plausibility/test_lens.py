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


def test_a_right_focal_length_lies_within_the_standard_error_stated(clean: Path) -> None:
    """The change was printed without one: nobody could tell 0.7 % from 0."""
    numbers = examine(Dataset((Recording.open(clean),))).numbers
    error = numbers["standard error of that change, %"]
    names = list(numbers)
    place = names.index("focal length should change by, %")
    assert names[place + 1] == "standard error of that change, %"
    assert 0 < error < 3
    assert abs(numbers["focal length should change by, %"]) < 3 * error
