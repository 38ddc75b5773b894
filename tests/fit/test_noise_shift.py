"""What the noise of the distances does to an estimate, and the estimate without it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from diagnosed_recordings import STILL, recorded

from tofcorr.data.recording import Recording
from tofcorr.estimation.moments import MomentObjective, Parameters
from tofcorr.fit.fitting import fit
from tofcorr.fit.problem import Fit, Shift
from tofcorr.options import resolve_options
from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.lattice import covered_domain
from tofcorr.training.calibration import TrainingOptions
from tofcorr.training.report import hand_eye_accuracy

SIGMA = 0.02  # metres


def _fitted(recording: Recording, **changes: object) -> Fit:
    dataset = Dataset((recording,))
    frames = np.arange(dataset.num_frames)
    options = resolve_options(TrainingOptions, "ea").model_copy(update=changes)
    return fit(dataset, frames, options, covered_domain(dataset, frames))


@pytest.fixture(scope="module")
def fits(tmp_path_factory: pytest.TempPathFactory) -> tuple[Fit, list[Fit]]:
    """Fits to a recording without noise, and to the same with other noise each time."""
    clean = recorded(tmp_path_factory.mktemp("shift") / "clean", 61, [], STILL, noise=False)
    random = np.random.default_rng(61)
    return _fitted(clean), [_fitted(_noisy(clean, SIGMA, random)) for _ in range(6)]


def _noisy(clean: Recording, sigma: float, random: np.random.Generator) -> Recording:
    depth = clean.depth + sigma * random.standard_normal(clean.depth.shape)
    return replace(clean, depth=depth.astype(np.float32))


def _moved(there: Parameters, found: list[Parameters]) -> torch.Tensor:
    """Return how far estimates are from one, in its camera's axes, (N, 3), metres."""
    turn, place = there.tool_from_camera[:3, :3], there.tool_from_camera[:3, 3]
    return torch.stack([turn.T @ (one.tool_from_camera[:3, 3] - place) for one in found])


def _shift(one: Fit) -> Shift:
    assert one.noise_shift is not None
    return one.noise_shift


def test_the_noise_moves_the_least_loss_as_far_as_is_said_and_the_estimate_not(
    fits: tuple[Fit, list[Fit]],
) -> None:
    clean, noisy = fits
    moved = _moved(clean.optimum, [one.optimum for one in noisy])
    said = torch.stack([_shift(one).twist for one in noisy])
    error = moved.std(0) / len(noisy) ** 0.5
    assert moved.mean(0)[2].abs() > 5 * error[2]
    assert float(moved.mean(0)[2]) == pytest.approx(float(said.mean(0)[2]), rel=0.3)
    left = _moved(clean.optimum, [one.solution.parameters for one in noisy])
    assert left.mean(0)[2].abs() < 0.3 * moved.mean(0)[2].abs()


def test_model_and_hand_eye_transform_are_those_of_the_estimate(
    fits: tuple[Fit, list[Fit]],
) -> None:
    """Moved alone, the hand-eye transform would no longer go with the correction."""
    one = fits[1][0]
    estimate = one.solution.parameters
    torch.testing.assert_close(one.model.hand_eye(), estimate.tool_from_camera)
    torch.testing.assert_close(one.model.error.coefficient_vector(), estimate.coefficients)
    assert not torch.allclose(estimate.coefficients, one.optimum.coefficients, atol=1e-6)


def test_an_estimate_may_stay_at_the_least_loss(tmp_path: Path) -> None:
    one = recorded(tmp_path / "one", 61, [], STILL)
    left, moved = _fitted(one, remove_noise_shift=False), _fitted(one)
    assert left.solution.parameters is left.optimum
    torch.testing.assert_close(_shift(left).twist, _shift(moved).twist)
    assert (_shift(left).removed, _shift(moved).removed) == (False, True)


def test_estimated_walls_move_along(tmp_path: Path) -> None:
    """On the walls of the least loss the points would be off by as much as the hand-eye moved."""
    clean = recorded(tmp_path / "clean", 61, [], STILL, noise=False)
    noisy = _noisy(clean, SIGMA / 4, np.random.default_rng(62))
    one = _fitted(noisy, planes="unknown")
    assert one.walls is not None
    there = _fitted(noisy, planes="unknown", remove_noise_shift=False)
    assert there.walls is not None
    seen = MomentObjective(one.moments).loss(one.solution.parameters)
    without = MomentObjective(there.moments).loss(one.solution.parameters)
    least = MomentObjective(there.moments).loss(there.optimum)
    assert not torch.equal(one.walls.walls.offset, there.walls.walls.offset)
    assert least < seen < least + 0.1 * (without - least)


@pytest.mark.parametrize("removed", [False, True])
def test_standard_errors_hold_what_the_noise_leaves_moved(
    fits: tuple[Fit, list[Fit]], removed: bool
) -> None:
    one = fits[1][0]
    shift = _shift(one)._replace(removed=removed)
    one = replace(one, noise_shift=shift)
    accuracy = hand_eye_accuracy(one)
    assert accuracy is not None
    said = torch.tensor(accuracy.translation_se_mm).square().sum()
    scatter = one.covariance.matrix[:3, :3].diagonal().sum()
    left = shift.twist[:3] * (0.2 if removed else 1.0)
    assert float(said) == pytest.approx(1e6 * float(scatter + left.square().sum()))
