"""Several cameras fitted together: what is shared couples them, what is not leaves them alone."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from simulated_walls import EA, simulated_wall, true_hand_eye

from tofcorr.fit.fitting import fit
from tofcorr.fit.joint import JointFit, adjoint, fit_together, shared_poses
from tofcorr.fit.problem import Fit, Problem
from tofcorr.geometry import se3
from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.lattice import covered_domain, lattice_of
from tofcorr.training.calibration import TrainingOptions

SHOTS = (("white", 20),)
REAR = {"translation_mm": [-60.0, 40.0, 100.0], "rotation_deg": [5.0, 12.0, -60.0]}


def problem(data: Dataset, planes: str) -> Problem:
    options = TrainingOptions.from_mapping({"name": "EA", "model": EA, "planes": planes}, "test")
    frames = np.arange(data.num_frames)
    lattice = lattice_of(data, frames)
    return Problem(data, frames, options, covered_domain(data, frames, lattice), lattice)


def alone(one: Problem) -> Fit:
    return fit(one.dataset, one.frames, one.options, one.domain)


@pytest.fixture(scope="module")
def cameras(tmp_path_factory: pytest.TempPathFactory) -> list[Dataset]:
    folder = tmp_path_factory.mktemp("cameras")
    front = simulated_wall(folder / "front", 7, SHOTS)
    beside = {"robot_of": str(folder / "front"), "hand_eye": REAR}
    return [front, simulated_wall(folder / "rear", 8, SHOTS, **beside)]


@pytest.fixture(scope="module")
def together(cameras: list[Dataset]) -> JointFit:
    return fit_together([problem(one, "unknown") for one in cameras])


def assert_same(found: Fit, other: Fit) -> None:
    one, two = found.solution.parameters, other.solution.parameters
    assert torch.allclose(one.tool_from_camera, two.tool_from_camera, rtol=0, atol=1e-8)
    assert torch.allclose(one.coefficients, two.coefficients, rtol=0, atol=1e-8)
    errors = (fit.covariance.matrix.diagonal().sqrt() for fit in (found, other))
    assert torch.allclose(*errors, rtol=1e-4)


def test_cameras_before_known_walls_are_those_of_two_fits(cameras: list[Dataset]) -> None:
    problems = [problem(one, "known") for one in cameras]
    for found, one in zip(fit_together(problems).fits, problems, strict=True):
        assert_same(found, alone(one))


def test_one_camera_together_is_one_camera_alone(cameras: list[Dataset]) -> None:
    one = problem(cameras[0], "unknown")
    assert_same(fit_together([one]).fits[0], alone(one))


def test_cameras_share_one_wall_and_the_error_of_each_stop(
    cameras: list[Dataset], together: JointFit
) -> None:
    walls = [one.walls for one in together.problems]
    assert walls[0] is not None
    assert walls[1] is not None
    assert torch.equal(walls[0].walls.normal_world, walls[1].walls.normal_world)
    assert torch.equal(walls[0].walls.offset, walls[1].walls.offset)
    first, second = shared_poses(together.problems)
    assert torch.equal(first, second)
    moved = replace(together.problems[1], frames=together.problems[1].frames[5:])
    assert torch.equal(shared_poses([together.problems[0], moved])[1], first[5:])
    assert together.covariance.degrees_of_freedom == cameras[0].num_frames - 1


def test_the_transform_between_cameras_is_known_better_than_each_and_holds_the_truth(
    cameras: list[Dataset], together: JointFit
) -> None:
    found, covariance = together.between(0, 1)
    true = se3.inverse(true_hand_eye(cameras[0])) @ true_hand_eye(cameras[1])
    off = se3.log(se3.inverse(true) @ found)
    assert float(off @ torch.linalg.solve(covariance, off)) < 30  # Of chi squared, of 6: 1 in 10^4.
    both = sum(float(one.hand_eye_covariance[:3, :3].trace()) for one in together.fits)
    assert float(covariance[:3, :3].trace()) < both


def test_the_covariance_between_cameras_is_that_of_small_moves_of_both(together: JointFit) -> None:
    """exp(-a) T exp(b) is T moved by b - A a, A the adjoint of the inverse: to second order."""
    there, _ = together.between(0, 1)
    one, two = 1e-4 * torch.randn(2, 6, dtype=torch.float64)
    moved = se3.inverse(se3.exp(one)) @ there @ se3.exp(two)
    wanted = two - adjoint(se3.inverse(there)) @ one
    assert torch.allclose(se3.log(se3.inverse(there) @ moved), wanted, atol=1e-7)


def test_a_wall_of_another_target_or_place_is_another_wall(cameras: list[Dataset]) -> None:
    names = np.full(cameras[1].num_frames, "checkerboard")
    other = cameras[1].with_columns(target=names)
    found = fit_together([problem(one, "unknown") for one in (cameras[0], other)])
    assert found.shared is not None
    assert [one.tolist() for one in found.shared] == [[0], [1]]
