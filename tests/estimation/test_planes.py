"""Walls nobody measured are found, and what that costs is said."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from optional import present
from simulated_walls import QUIET, SENSOR, fitted, simulated_wall, true_hand_eye

from tofcorr.errors import CalibrationDataError
from tofcorr.estimation.moments import MomentObjective
from tofcorr.estimation.planes import joint_image_equations, marginal_hessian
from tofcorr.fit.problem import Fit
from tofcorr.fit.walls import name_walls, recorded_walls
from tofcorr.geometry.camera import FrameNames
from tofcorr.pixels.dataset import Dataset
from tofcorr.training.report import hand_eye_summary

BRIGHT = SENSOR | QUIET


def misplaced(dataset: Dataset, shift: float, tilt: float) -> Dataset:
    """Return the data set with a wrong plane in frames.csv."""
    table = dataset.first.frames
    normal = np.tile([np.sin(tilt), 0.0, np.cos(tilt)], (len(table), 1))
    wrong = replace(table, normal_world=normal, offset=table.offset + shift)
    return Dataset((replace(dataset.first, frames=wrong),))


@pytest.fixture(scope="module")
def wall(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return simulated_wall(tmp_path_factory.mktemp("wall") / "wall", seed=1, sensor=BRIGHT)


@pytest.fixture(scope="module")
def found(wall: Dataset) -> Fit:
    return fitted(misplaced(wall, 0.3, 0.3), planes="unknown")


def test_a_wall_recorded_30_cm_and_17_degrees_wrong_is_found(wall: Dataset, found: Fit) -> None:
    walls = present(found.walls)
    assert [one["wall"] for one in walls.summary()] == ["checkerboard", "white"]
    assert float(walls.walls.normal_world[:, 2].min()) > np.cos(2e-3)
    assert float(walls.walls.offset.abs().max()) < 6e-3
    apart = found.solution.parameters.tool_from_camera - true_hand_eye(wall)
    half_mm = hand_eye_summary(found, FrameNames())["translation_ci95_mm"]
    assert bool((1e3 * apart[:3, 3].abs() < 1.5 * torch.tensor(half_mm)).all())


def test_where_the_wrong_start_was_does_not_matter(wall: Dataset, found: Fit) -> None:
    from_truth = fitted(wall, planes="unknown").solution.parameters
    apart = from_truth.tool_from_camera - found.solution.parameters.tool_from_camera
    assert float(apart.abs().max()) < 1e-5


@pytest.mark.slow
def test_robust_weights_look_at_the_wall_found_and_not_at_the_one_recorded(wall: Dataset) -> None:
    """They looked at the recorded plane: a guess 17 degrees off made every pixel an outlier."""
    robust = {"planes": "unknown", "weights": {"robust": "cauchy"}}
    found = fitted(misplaced(wall, 0.3, 0.3), **robust).solution.parameters
    expected = fitted(wall, **robust).solution.parameters
    apart = expected.tool_from_camera - found.tool_from_camera
    assert float(apart.abs().max()) < 1e-5


def test_not_knowing_the_wall_costs_certainty(wall: Dataset, found: Fit) -> None:
    known = fitted(wall)
    ratio = (found.covariance.matrix / known.covariance.matrix).diagonal()[:6].sqrt()
    assert float(ratio.min()) > 0.9
    assert float(ratio[2]) > 1.5
    assert found.observability.directions[0].sigma > known.observability.directions[0].sigma


def test_without_tilt_an_unknown_wall_is_undetermined_with_t_z_and_c0(tmp_path: Path) -> None:
    dataset = simulated_wall(tmp_path / "flat", sensor=BRIGHT, robot={"tilt_axes": "none"})
    result = fitted(dataset, planes="unknown")
    unknown = [d for d in result.observability.directions if d.sigma > 0.05]
    named = set().union(*(direction.shares for direction in unknown))
    assert {"t_x", "t_y", "t_z", "w_z", "c0"} <= named
    assert result.prior is not None
    guess = torch.from_numpy(np.array(dataset.first.tool_from_camera))
    apart = result.solution.parameters.tool_from_camera - guess
    assert float(apart[:3, 3].norm()) < 0.2


def test_the_derivative_by_the_walls_is_that_of_the_loss(wall: Dataset, found: Fit) -> None:
    walls, best = present(found.walls).walls, found.solution.parameters
    equations = joint_image_equations(walls.seen_by(found.moments), best, walls)

    def loss(step: torch.Tensor) -> torch.Tensor:
        moved = walls.moved(step[best.size :])
        return MomentObjective(moved.seen_by(found.moments)).loss(best.moved(step[: best.size]))

    zero = torch.zeros(best.size + walls.size, dtype=torch.float64)
    off = zero + 1e-3
    slope = torch.autograd.functional.jacobian(loss, off)
    assert isinstance(slope, torch.Tensor)
    # At a point off the optimum the slope is that of the quadratic model to first order.
    hessian = equations.hessian.sum(dim=0)
    model = 2 * (equations.gradient.sum(dim=0) + hessian @ off)
    torch.testing.assert_close(slope, model, rtol=0.05, atol=float(model.abs().max()) * 0.02)


def test_the_marginal_curvature_is_the_inverse_of_the_covariances_block(found: Fit) -> None:
    walls, best = present(found.walls).walls, found.solution.parameters
    hessian = joint_image_equations(found.moments, best, walls).hessian.sum(dim=0)
    block = torch.linalg.inv(hessian)[: best.size, : best.size]
    marginal = marginal_hessian(found.moments, best, walls)
    scale = block.diagonal().sqrt()
    identity = (marginal @ block) * scale[None, :] / scale[:, None]
    torch.testing.assert_close(identity, torch.eye(best.size).double(), atol=1e-4, rtol=0)


def test_walls_of_two_places_are_told_apart_by_name(wall: Dataset) -> None:
    table = wall.first.frames
    offset = np.array(table.offset)
    offset[:12] += 0.5
    moved = Dataset((replace(wall.first, frames=replace(table, offset=offset)),))
    _, names = name_walls(moved)
    assert set(names) == {"checkerboard (1)", "checkerboard (2)", "white (1)", "white (2)"}


def test_a_wall_of_two_images_is_refused(wall: Dataset) -> None:
    white = np.flatnonzero(wall.targets == "white")
    board = np.flatnonzero(wall.targets == "checkerboard")
    frames = np.concatenate([white, board[:2]])
    with pytest.raises(CalibrationDataError, match="'checkerboard' has 2"):
        recorded_walls(wall, frames)


def test_frames_held_out_get_the_wall_that_was_found(wall: Dataset) -> None:
    found = recorded_walls(wall, np.arange(wall.num_frames))
    step = torch.zeros(found.walls.size, dtype=torch.float64)
    step[2] = 0.25
    table = replace(found, walls=found.walls.moved(step)).put_into(wall).first.frames
    change = table.offset - wall.first.frames.offset
    assert np.allclose(change, np.where(found.of_frame == 0, 0.25, 0.0))


def test_a_masked_recording_needs_no_mask(wall: Dataset) -> None:
    depth = np.array(wall.first.depth)
    depth[:, :, :10] = 0.4 + 0.1 * np.random.default_rng(0).random(depth[:, :, :10].shape)
    cluttered = Dataset((replace(wall.first, depth=depth),))
    best = fitted(cluttered, mask="ransac").solution.parameters.tool_from_camera
    assert float((best - true_hand_eye(wall))[:3, 3].norm()) < 4e-3
