"""Pixels far off their plane count by how far they pull a fit, and not by their number alone."""

from dataclasses import replace

import numpy as np
import pytest

from tofcorr.data.recording import Recording
from tofcorr.options import resolve_options
from tofcorr.pixels.dataset import Dataset
from tofcorr.plausibility.examine import examine
from tofcorr.plausibility.finding import Inspection
from tofcorr.training.calibration import TrainingOptions
from tofcorr.training.judgement import against_garbage


def _with_far_pixels(white_wall: Recording, share: float, metres: float) -> Inspection:
    generator = np.random.default_rng(5)
    far = generator.random(white_wall.depth.shape) < share
    depth = (np.asarray(white_wall.depth) + metres * far).astype(np.float32)
    return examine(Dataset((replace(white_wall, depth=depth),)))


@pytest.mark.parametrize(
    ("share", "metres", "doubted", "robust"),
    [
        (0.0, 0.0, False, False),
        (0.0004, 0.12, False, False),
        (0.006, 0.3, False, True),
        (0.006, 2.5, True, True),
        (0.02, 0.3, True, True),
    ],
)
def test_few_pixels_count_if_they_are_very_far_off_or_make_most_of_the_squares_of_a_fit(
    white_wall: Recording, share: float, metres: float, *, doubted: bool, robust: bool
) -> None:
    """0.8 % wrapped by 1.9 m moved the hand-eye transform by 38 mm; they were only noted.

    0.4 % of flying pixels made 17 of 17.4 mm RMS: such runs were not to be used.
    """
    found = _with_far_pixels(white_wall, share, metres)
    said = [one for one in found.findings if one.check == "garbage"]
    assert any(one.severity != "note" for one in said) == doubted
    options = against_garbage(resolve_options(TrainingOptions, "ea"), found)
    assert (options.weights.robust != "none") == robust
    # What a training leaves out already, nobody is told to mask for it.
    assert all(("leave them out" in one.sentence) == robust for one in said)
    assert all(("; mask them" in one.sentence) != robust for one in said)
