"""What errors of the intrinsics and of the planes would do is what a fit with them does."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from simulated_walls import QUIET, fitted, simulated_wall

from tofcorr.data.recording import Recording
from tofcorr.fit.misfit import assumptions, misfit_pixels
from tofcorr.fit.problem import Fit, Shift
from tofcorr.geometry import se3
from tofcorr.geometry.rays import tangents
from tofcorr.pixels.dataset import Dataset


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    folder = tmp_path_factory.mktemp("assumptions") / "recording"
    return simulated_wall(folder, 23, (("white", 12), ("checkerboard", 16)), QUIET)


@pytest.fixture(scope="module")
def right(data: Dataset) -> Fit:
    return fitted(data)


@pytest.fixture(scope="module")
def found(data: Dataset, right: Fit) -> dict[str, Shift]:
    seen = misfit_pixels(data, right, np.arange(data.num_frames))
    assert seen is not None
    return {one.cause: one for one in assumptions(seen, right)}


def _with_k(recording: Recording, focal: float, right: float, down: float) -> Recording:
    (fx, skew, cx), (_, fy, cy), _ = recording.camera.matrix
    rows = ((focal * fx, skew, cx + right), (0.0, focal * fy, cy + down), (0.0, 0.0, 1.0))
    return replace(recording, camera=replace(recording.camera, matrix=rows))


def _with_offset(recording: Recording) -> Recording:
    table = recording.frames
    return replace(recording, frames=replace(table, offset=table.offset + 1e-3))


@pytest.mark.parametrize(
    ("name", "wrong"),
    [
        ("focal_length", lambda one: _with_k(one, 1.001, 0.0, 0.0)),
        ("principal_point_right", lambda one: _with_k(one, 1.0, 1.0, 0.0)),
        ("principal_point_down", lambda one: _with_k(one, 1.0, 0.0, 1.0)),
        ("plane_offset", _with_offset),
    ],
)
def test_a_fit_to_a_wrong_recording_moves_as_far(
    name: str,
    wrong: Callable[[Recording], Recording],
    data: Dataset,
    right: Fit,
    found: dict[str, Shift],
) -> None:
    """A focal length 0.3 % off moved it by 4.5 of its standard errors, and nothing said so."""
    other = fitted(Dataset((wrong(data.first),)))
    before = right.solution.parameters.tool_from_camera
    moved = torch.linalg.inv(before) @ other.solution.parameters.tool_from_camera
    twist = torch.cat([moved[:3, 3], se3.log(moved)[3:]])
    # A linear step, from a sample of the pixels: to a tenth, and 0.1 mm or mrad.
    assert float((twist - found[name].twist).norm()) < 0.1 * float(twist.norm()) + 1e-4


def test_turned_planes_move_the_camera_as_far(
    data: Dataset, right: Fit, found: dict[str, Shift]
) -> None:
    """About no axis of the wall, through its middle, does a turn move the camera farther."""
    seen = misfit_pixels(data, right, np.arange(data.num_frames))
    assert seen is not None
    table, angle = data.first.frames, np.radians(0.1)
    across = tangents(torch.from_numpy(table.normal_world)).numpy()
    before = right.solution.parameters.tool_from_camera
    pose = (torch.from_numpy(table.world_from_tool) @ before)[seen.frame]
    world = torch.einsum("mij,mj->mi", pose[:, :3, :3], seen.linear.points) + pose[:, :3, 3]
    places = np.einsum("ma,mka->mk", world.numpy(), across[seen.frame.numpy()])
    shifts = []
    for axis in (0, 1):
        turned = np.cos(angle) * table.normal_world + np.sin(angle) * across[:, axis]
        offset = table.offset - np.sin(angle) * np.median(places[:, axis])
        frames = replace(table, normal_world=turned, offset=offset)
        other = fitted(Dataset((replace(data.first, frames=frames),)))
        moved = torch.linalg.inv(before) @ other.solution.parameters.tool_from_camera
        shifts.append(moved[:3, 3].numpy())
    worst = np.linalg.svd(np.stack(shifts), compute_uv=False)[0]
    assert float(found["plane_tilt"].twist[:3].norm()) == pytest.approx(worst, rel=0.15, abs=1e-4)


def test_planes_that_are_estimated_are_not_assumed(data: Dataset, right: Fit) -> None:
    seen = misfit_pixels(data, right, np.arange(8))
    assert seen is not None
    seen = replace(seen, walls_estimated=True)
    names = {one.cause for one in assumptions(seen, right)}
    lens = {"focal_length", "principal_point_right", "principal_point_down"}
    assert names == {*lens, "robot_scale"}
