"""The board's plane follows from its corners, and doubtful ones are refused."""

import math
from itertools import pairwise

import numpy as np
import pytest
from importing.checkerboard.rendered_board import (
    BOARD,
    CAMERA,
    Placement,
    centre,
    placement,
    project,
    rays,
    varied_placements,
)

from tofcorr.importing.checkerboard.boards import estimate_pose
from tofcorr.importing.run import RefusedViewError


@pytest.mark.parametrize("where", varied_placements(6))
def test_exact_corners_give_the_exact_plane_facing_the_camera(where: Placement) -> None:
    pose = estimate_pose(project(where), BOARD, CAMERA, 0.5)
    normal, offset = pose.plane()
    assert offset > 0  # The camera at the origin lies on the side the normal points to.
    np.testing.assert_allclose(normal, where.normal, atol=1e-6)
    np.testing.assert_allclose(offset, where.offset, atol=1e-6)


def test_a_corner_gone_astray_is_left_out() -> None:
    where = placement(0.6, tilt_x=25, tilt_y=10)
    corners = project(where)
    corners[12] += (3.0, -2.0)
    pose = estimate_pose(corners, BOARD, CAMERA, 0.5)
    assert np.flatnonzero(~pose.used).tolist() == [12]
    np.testing.assert_allclose(pose.plane()[0], where.normal, atol=1e-6)


@pytest.mark.parametrize(
    ("distance", "tilt", "moved", "by", "said"),
    [
        (0.6, 25, 35, 2.0, r"miss the board by \d\.\d\d px.*0\.5 px"),
        (0.6, 25, 10, 30.0, r"corners fit one pose|miss the board"),
        # Its tilt could be either way.
        (3.0, 10, 35, 0.1, "two different poses"),
    ],
    ids=["no board", "a row astray", "far"],
)
def test_corners_of_no_board_and_of_two_are_refused(
    distance: float, tilt: float, moved: int, by: float, said: str
) -> None:
    corners = project(placement(distance, tilt_x=tilt))
    corners[:moved] += np.random.default_rng(3).normal(0, by, (moved, 2))
    with pytest.raises(RefusedViewError, match=said):
        estimate_pose(corners, BOARD, CAMERA, 0.5)


def test_the_stated_deviation_of_the_plane_is_the_scatter_under_noise() -> None:
    where = placement(0.7, tilt_x=25, tilt_y=-15)
    generator = np.random.default_rng(4)
    placed, stated = [], []
    for _ in range(150):
        corners = project(where) + generator.normal(0, 0.08, (35, 2))
        pose = estimate_pose(corners, BOARD, CAMERA, 1.0)
        at = np.append(centre(pose, BOARD), 1.0)
        placed.append(at @ [*where.normal, where.offset])
        stated.append(math.sqrt(at @ pose.plane_covariance @ at))
    # A standard deviation from 150 draws is known to 6 %: three of those on either side.
    assert np.std(placed) == pytest.approx(np.mean(stated), rel=0.2)


@pytest.mark.parametrize("margin", [-0.5, 0.0, 1.0])
def test_the_area_is_the_projected_outline_of_the_board(margin: float) -> None:
    where = placement(0.5, tilt_x=30, roll=25)
    pose = estimate_pose(project(where), BOARD, CAMERA, 0.5)
    area = pose.area(BOARD, rays(CAMERA), margin)
    inside = signed_distance_to_outline(where, margin)
    assert np.all(area[inside > 0.1])
    assert not np.any(area[inside < -0.1])


def signed_distance_to_outline(where: Placement, margin: float) -> np.ndarray:
    """Pixels inside (positive) the outline, drawn as a fine polygon in the image."""
    import cv2

    side = np.linspace(0, 1, 50)[:, None]
    (left, top), (right, bottom) = (-margin, -margin), (4 + margin, 6 + margin)
    around = np.array([(left, top), (right, top), (right, bottom), (left, bottom), (left, top)])
    outline = np.concatenate([a + side * (b - a) for a, b in pairwise(around)])
    points = np.concatenate([outline * BOARD.square_length, np.zeros((len(outline), 1))], 1)
    polygon = project(where, points=points).astype(np.float32)[:, None]
    inside = [cv2.pointPolygonTest(polygon, (u, v), True) for v in range(240) for u in range(320)]
    return np.reshape(inside, (240, 320))


def test_distance_runs_along_the_ray_to_the_plane_and_a_board_behind_is_nowhere() -> None:
    where = placement(0.5, tilt_x=30)
    pose = estimate_pose(project(where), BOARD, CAMERA, 0.5)
    directions = rays(CAMERA)[100:110, 100:110].reshape(-1, 3)
    points = pose.distance(directions)[:, None] * directions
    np.testing.assert_allclose(points @ where.normal + where.offset, 0, atol=1e-6)
    assert not pose.area(BOARD, -rays(CAMERA), 1.0).any()
