"""The intervals hold the truth as often as they say."""

from pathlib import Path

import numpy as np
import pytest
import torch
from simulated_walls import EA, QUIET, SENSOR, wall_options

from benchmarks.hand_eye_bias import measured
from tofcorr.simulation.simulator import simulate
from tofcorr.training.calibration import TrainingOptions


@pytest.mark.slow
def test_95_percent_intervals_of_the_hand_eye_hold_the_truth_about_as_often(tmp_path: Path) -> None:
    options, model = wall_options(0, sensor=SENSOR | QUIET), TrainingOptions(name="EA", model=EA)
    true, held = options.hand_eye.tool_from_camera().numpy(), []
    for seed in range(1_000_003, 1_000_063):
        folder = tmp_path / str(seed)
        simulate(options, folder, torch.Generator().manual_seed(seed))
        _, error, _, _, half, _ = measured(folder, model, true)
        held.append(np.abs(error) <= half)
    translation, rotation = np.mean(held, axis=0).reshape(2, 3).mean(axis=1)
    # 60 recordings of three axes each: the standard error of a coverage of 0.95 is 0.03 if the
    # axes of one recording go together.
    assert translation == pytest.approx(0.95, abs=0.07)
    assert rotation == pytest.approx(0.95, abs=0.07)
