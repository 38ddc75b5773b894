"""A lens model that gives some pixels no viewing ray is named, and not taken for clutter."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tofcorr.data.recording import Recording
from tofcorr.pixels.dataset import Dataset
from tofcorr.plausibility.examine import examine
from tofcorr.plausibility.linear import Estimate
from tofcorr.plausibility.look import Look


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
    assert 0 < error < 3
    assert abs(numbers["focal length should change by, %"]) < 3 * error


@pytest.mark.parametrize("name", ["focal", "aspect", "centre", "corner", "bend"])
def test_an_error_by_an_amplitude_that_is_not_recorded_is_none_of_the_camera_matrix(
    white_wall: Recording, name: str
) -> None:
    """It moved the focal length by 2.8 standard errors, and up to 6 in other recordings."""
    amplitude, depth = np.asarray(white_wall.amplitude), np.asarray(white_wall.depth)
    error = -0.02 * np.log(np.maximum(amplitude, 1.0) / np.median(amplitude))

    def shape(depth: np.ndarray) -> Estimate:
        alone = replace(white_wall, depth=depth.astype(np.float32), amplitude=None)
        found = Look(Dataset((alone,))).shape
        assert found is not None
        return found[name]

    before, after = (shape(one) for one in (depth, depth + error))
    assert (np.abs(after.value - before.value) < before.error).all()
