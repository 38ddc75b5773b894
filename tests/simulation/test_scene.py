"""The pattern on the wall, and what a pixel sees of it."""

import math

import pytest
import torch
from torch import Tensor

from tofcorr.geometry.se3 import world_from_plane
from tofcorr.simulation.scene import CheckerboardTarget, seen_reflectivity


def _grid(height: int, width: int, step: float, turn: float = 0.0) -> Tensor:
    """Return target coordinates of a frontal camera, pixels `step` metres apart, turned."""
    sides = (torch.arange(size, dtype=torch.float64) for size in (height, width))
    down, right = torch.meshgrid(*sides, indexing="ij")
    cosine, sine = math.cos(turn), math.sin(turn)
    return step * torch.stack([cosine * right - sine * down, sine * right + cosine * down], -1)


@pytest.mark.parametrize("turn", [0.0, 0.3, math.pi / 4])
def test_area_average_conserves_mean_reflectivity(turn: float) -> None:
    board = CheckerboardTarget(square_mm=100.0, reflectivity_dark=0.1, reflectivity_bright=0.9)
    # 7.3 mm a pixel and 274 pixels: twenty squares, so the true mean is that of both colours.
    seen = seen_reflectivity(board, _grid(274, 274, 0.0073, turn), subsamples=5)
    assert seen.mean().item() == pytest.approx(0.5, abs=5e-3)


def test_footprint_cut_by_an_edge_has_the_shares_of_both_squares() -> None:
    board = CheckerboardTarget(square_mm=100.0, reflectivity_dark=0.0, reflectivity_bright=1.0)
    # Pixels of 10 mm in the middle of a row of squares; the edge at x = 100 mm cuts the one
    # whose centre is at x = 102 mm at 30 % of its width.
    along = torch.arange(20, dtype=torch.float64) * 0.010 + 0.002
    row = torch.stack([along, torch.full_like(along, 0.05)], -1)
    seen = seen_reflectivity(board, torch.stack([row, row + row.new_tensor([0, 0.01])]), 10)[0]
    # The square from 0 to 100 mm is dark, its neighbour bright.
    assert seen[10].item() == pytest.approx(0.7, abs=1e-12)
    assert seen[1:10].eq(0.0).all()
    assert seen[11:].eq(1.0).all()


@pytest.mark.parametrize("normal", [(0, 0, 1), (1, 0, 0), (0.6, -0.48, 0.64)])
def test_plane_frame_lies_in_the_plane(normal: tuple[float, float, float]) -> None:
    n = torch.tensor(normal, dtype=torch.float64)
    frame = world_from_plane(n, torch.tensor(-1.7, dtype=torch.float64))
    points = torch.randn(5, 4, dtype=torch.float64)
    points[:, 2], points[:, 3] = 0.0, 1.0
    world = points @ frame.T
    torch.testing.assert_close(world[:, :3] @ n, torch.full((5,), 1.7, dtype=torch.float64))
    rotation = frame[:3, :3]
    torch.testing.assert_close(rotation @ rotation.T, torch.eye(3, dtype=torch.float64))
    assert torch.linalg.det(rotation).item() == pytest.approx(1.0)
