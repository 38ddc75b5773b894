"""Fixed pattern and residual network on simulated walls: what is learnt, kept and carried on."""

from pathlib import Path

import numpy as np
import pytest
import torch
from simulated_walls import SENSOR, simulated_wall
from synthetic_scene import EA

from tofcorr.correction.state import load_calibration, save_calibration
from tofcorr.fit.fitting import fit
from tofcorr.fit.problem import Fit
from tofcorr.fit.residual import gate
from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.lattice import covered_domain
from tofcorr.pixels.passes import frame_errors
from tofcorr.simulation.signal import PixelDelayOptions, pixel_delay
from tofcorr.training.calibration import TrainingOptions
from tofcorr.training.run import calibration_state

LOG = {"kind": "amplitude_polynomial", "variable": "log_amplitude", "degree": 2}
CORE = [*EA["terms"][:2], LOG]
NETWORK = {"pixels": 2000, "iterations": 100, "folds": 3}
# Waves of a length that no cubic follows within half a metre to two and a half.
WAVY = SENSOR | {
    "light": {"electrons_at_1m": 4.0e6, "demodulation_contrast": 0.5},
    "modulation_frequency_hz": 60.0e6,
    "harmonics": [{"order": 3, "share": 0.05}],
}
ROBOT = {"distance_m": [0.5, 2.2], "farthest_pixel_m": 2.45}
TEST = np.arange(2, 30, 5)
TRAIN = np.setdiff1d(np.arange(30), TEST)


def fitted(dataset: Dataset, terms: list[dict], **options: object) -> Fit:
    values = {"name": "test", "model": {"terms": terms}} | options
    training = TrainingOptions.from_mapping(values, "test")
    return fit(dataset, TRAIN, training, covered_domain(dataset, TRAIN))


def held_out(dataset: Dataset, found: Fit) -> float:
    return frame_errors(dataset, {"model": found.model})["model"]["to_plane"].rms_mm(TEST)


@pytest.fixture(scope="module")
def wavy(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    folder = tmp_path_factory.mktemp("wavy") / "recording"
    return simulated_wall(folder, sensor=WAVY, robot=ROBOT)


@pytest.fixture(scope="module")
def wavy_fit(wavy: Dataset) -> Fit:
    return fitted(wavy, CORE, residual=NETWORK)


def test_network_is_kept_and_helps_where_the_truth_is_outside_every_polynomial(
    wavy: Dataset, wavy_fit: Fit
) -> None:
    assert wavy_fit.model.error.residual is not None
    assert "was kept" in str(wavy_fit.residual)
    # The waves are shorter than the radius: it must become shorter along the distance alone.
    assert held_out(wavy, wavy_fit) < 0.2 * held_out(wavy, fitted(wavy, CORE))


def test_network_is_dropped_where_the_core_is_the_truth(tmp_path: Path) -> None:
    dataset = simulated_wall(tmp_path / "recording")
    found = fitted(dataset, CORE, residual=NETWORK)
    assert found.model.error.residual is None
    assert "was dropped" in str(found.residual)
    assert held_out(dataset, found) == held_out(dataset, fitted(dataset, CORE))


def test_gate_refuses_a_worse_tail_beside_a_better_mean(generator: torch.Generator) -> None:
    absolute = 4 + torch.rand(60, generator=generator).double()
    without = torch.stack([absolute, 1.5 * absolute.square()])
    better = without * torch.tensor([[0.8], [0.7]])
    tail = better.clone()
    tail[1, :3] += 400  # Three views are far off.
    assert gate(without, better) < 1e-6
    assert gate(without[:1], tail[:1]) < 1e-6
    assert gate(without, tail) > 0.5
    assert gate(without[:, :2], better[:, :2]) == 1


def test_joint_training_lowers_the_loss_of_the_sample_further(wavy: Dataset) -> None:
    short = NETWORK | {"keep": "always", "iterations": 20, "folds": 2}
    apart = fitted(wavy, CORE, residual=short | {"joint": False})
    joint = fitted(wavy, CORE, residual=short)
    errors = frame_errors(wavy, {"apart": apart.model, "joint": joint.model})
    assert errors["joint"]["to_plane"].rms_mm(TRAIN) < errors["apart"]["to_plane"].rms_mm(TRAIN)
    moved = joint.solution.parameters.coefficients - apart.solution.parameters.coefficients
    assert moved.abs().max() > 0


def test_trained_network_travels_with_the_calibration(
    wavy: Dataset, wavy_fit: Fit, tmp_path: Path
) -> None:
    error = wavy_fit.model.error
    values = {"name": "test", "model": {"terms": CORE}, "residual": NETWORK}
    state = calibration_state(wavy, TrainingOptions.from_mapping(values, "test"), wavy_fit)
    assert state.residual is not None
    save_calibration(tmp_path / "state.pt", state)
    again = load_calibration(tmp_path / "state.pt")
    assert wavy.first.amplitude is not None
    depth = torch.from_numpy(np.array(wavy.first.depth[:2]))
    amplitude = torch.from_numpy(np.array(wavy.first.amplitude[:2]))
    expected, valid = again.corrected(depth, amplitude)
    by_model = depth.double() - error(depth.double(), amplitude.double())
    torch.testing.assert_close(expected[valid], by_model[valid].detach())


def test_fixed_pattern_is_that_of_the_simulated_chip(tmp_path: Path) -> None:
    pixel = {"irregular_mm": 4.0, "unit": 3}
    sensor = WAVY | {"harmonics": [], "delays": SENSOR["delays"] | {"pixel": pixel}}
    dataset = simulated_wall(tmp_path / "recording", sensor=sensor)
    found = fitted(dataset, [*CORE, {"kind": "fixed_pattern"}])
    assert found.model.error.fixed_pattern is not None
    offset = found.model.error.fixed_pattern.offset
    rays = dataset.ray_directions()
    truth = pixel_delay(PixelDelayOptions.from_mapping(pixel, "test"), rays)
    correlation = torch.corrcoef(torch.stack([offset.flatten(), truth.flatten()]))[0, 1]
    assert float(correlation) > 0.95
    assert float(offset.std()) == pytest.approx(4e-3, rel=0.15)
    assert held_out(dataset, found) < held_out(dataset, fitted(dataset, CORE))


def test_drift_over_temperature_and_time_is_found(tmp_path: Path) -> None:
    effects = [
        {"name": "room_temperature", "per_degree": 0.008},
        {"name": "warm_up", "rise_s": [40.0], "rise_40s": 0.02},
    ]
    conditions = {"room_drift_c": 4.0, "room_period_s": 70.0, "frame_interval_s": 5.0}
    dataset = simulated_wall(tmp_path / "recording", effects=effects, conditions=conditions)
    drifting = [{"kind": "room_temperature"}, {"kind": "warm_up"}]
    found = fitted(dataset, [*CORE, *drifting])
    assert held_out(dataset, found) < 0.8 * held_out(dataset, fitted(dataset, CORE))
