"""A calibrated camera and a few frames to check it with; simulated once."""

from functools import cache

import numpy as np
import pytest
from drift.few_walls import FEW, Walls, sensor
from optional import present
from simulated_walls import EA, fitted, simulated_wall

from tofcorr.correction.state import CalibrationState
from tofcorr.fit.problem import Fit
from tofcorr.fit.reference import Reference, estimate_reference
from tofcorr.pixels.dataset import Dataset
from tofcorr.training.calibration import TrainingOptions
from tofcorr.training.run import calibration_state


@pytest.fixture(scope="session")
def calibrated(tmp_path_factory: pytest.TempPathFactory) -> tuple[Dataset, Fit]:
    dataset = simulated_wall(tmp_path_factory.mktemp("wall") / "wall", sensor=sensor())
    return dataset, fitted(dataset, weights={"noise": True})


@pytest.fixture(scope="session")
def reference(calibrated: tuple[Dataset, Fit], state: CalibrationState) -> Reference:
    dataset, fit = calibrated
    return present(estimate_reference(dataset, np.arange(dataset.num_frames), fit, state.noise))


@pytest.fixture(scope="session")
def walls(tmp_path_factory: pytest.TempPathFactory) -> Walls:
    """Return a few frames by seed and shift of the camera, simulated once; not to be changed."""

    @cache
    def few(seed: int, shift_mm: float = 0.0) -> Dataset:
        folder = tmp_path_factory.mktemp("few") / "few"
        return simulated_wall(folder, seed, FEW, sensor=sensor(shift_mm))

    return few


@pytest.fixture(scope="session")
def state(calibrated: tuple[Dataset, Fit]) -> CalibrationState:
    options = TrainingOptions.from_mapping({"name": "EA", "model": EA}, "test")
    return calibration_state(calibrated[0], options, calibrated[1])
