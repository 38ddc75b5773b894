"""Pixels far off their plane count by how far they pull a fit, and not by their number alone."""

from dataclasses import replace

import diagnosed_recordings
import numpy as np
import pytest

from tofcorr.data.recording import Recording
from tofcorr.options import resolve_options
from tofcorr.pixels.dataset import Dataset
from tofcorr.plausibility.examine import examine
from tofcorr.plausibility.finding import Inspection
from tofcorr.training.calibration import TrainingOptions
from tofcorr.training.judgement import against_garbage


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    folder = tmp_path_factory.mktemp("garbage") / "recording"
    changes = {"shots": [{"target": "white", "poses": 40}]}
    return diagnosed_recordings.recorded(folder, 72, changes=changes, noise=False)


def _with_far_pixels(recording: Recording, share: float, metres: float) -> Inspection:
    generator = np.random.default_rng(5)
    far = generator.random(recording.depth.shape) < share
    depth = (np.asarray(recording.depth) + metres * far).astype(np.float32)
    return examine(Dataset((replace(recording, depth=depth),)))


@pytest.mark.parametrize(
    ("share", "metres", "doubted"),
    [(0.006, 0.3, False), (0.006, 2.5, True), (0.02, 0.3, True), (0.0, 0.0, False)],
)
def test_few_pixels_count_if_they_are_very_far_off(
    recording: Recording, share: float, metres: float, *, doubted: bool
) -> None:
    """0.8 % wrapped by 1.9 m moved the hand-eye transform by 38 mm; they were only noted."""
    found = _with_far_pixels(recording, share, metres)
    doubts = [one for one in found.findings if one.check == "garbage" and one.severity != "note"]
    assert bool(doubts) == doubted


@pytest.mark.parametrize(
    ("share", "metres", "robust"),
    [(0.0004, 0.12, False), (0.006, 0.3, True), (0.006, 2.5, True), (0.02, 0.3, True)],
)
def test_a_fit_is_robust_where_far_pixels_would_make_most_of_its_squares(
    recording: Recording, share: float, metres: float, *, robust: bool
) -> None:
    """0.4 % of flying pixels made 17 of 17.4 mm RMS: such runs were not to be used."""
    found = _with_far_pixels(recording, share, metres)
    options = against_garbage(resolve_options(TrainingOptions, "ea"), found)
    assert (options.weights.robust != "none") == robust
    # What a training leaves out already, nobody is told to mask for it.
    told = [one.sentence for one in found.findings if one.check == "garbage"]
    assert all(("leave them out" in one) == robust for one in told)
    assert all(("; mask them" in one) != robust for one in told)
