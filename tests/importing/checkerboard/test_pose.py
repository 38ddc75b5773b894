"""The board's plane follows from its corners, and doubtful ones are refused."""

import numpy as np
import pytest
from importing.checkerboard.rendered_board import (
    BOARD,
    CAMERA,
    Placement,
    angle_deg,
    infrared,
    placement,
    project,
    rays,
    varied_placements,
)

from tofcorr.importing.checkerboard.pose import estimate_pose
from tofcorr.importing.run import RefusedViewError


@pytest.mark.parametrize("where", varied_placements(6))
def test_exact_corners_give_the_exact_plane_facing_the_camera(where: Placement) -> None:
    pose = estimate_pose(project(where), BOARD, CAMERA, 0.5)
    normal, offset = pose.plane()
    assert offset > 0  # The camera at the origin lies on the side the normal points to.
    np.testing.assert_allclose(normal, where.normal, atol=1e-6)
    np.testing.assert_allclose(offset, where.offset, atol=1e-6)


@pytest.mark.parametrize("where", varied_placements(3, seed=8))
def test_the_plane_of_a_rendered_board_is_found_to_a_millimetre(where: Placement) -> None:
    corners = BOARD.find(infrared(where))
    assert corners is not None
    pose = estimate_pose(corners, BOARD, CAMERA, 0.5)
    normal, _ = pose.plane()
    assert angle_deg(normal, where.normal) < 0.4
    # The plane's place at the board's centre: both centres lie on both planes.
    assert abs(where.normal @ pose.centre(BOARD) + where.offset) < 1e-3


def test_a_corner_gone_astray_is_left_out() -> None:
    where = placement(0.6, tilt_x=25, tilt_y=10)
    corners = project(where)
    corners[12] += (3.0, -2.0)
    pose = estimate_pose(corners, BOARD, CAMERA, 0.5)
    assert np.flatnonzero(~pose.used).tolist() == [12]
    np.testing.assert_allclose(pose.plane()[0], where.normal, atol=1e-6)


def test_corners_that_fit_no_board_are_refused() -> None:
    corners = project(placement(0.6, tilt_x=25))
    scattered = corners + np.random.default_rng(1).normal(0, 2.0, corners.shape)
    with pytest.raises(RefusedViewError, match=r"miss the board by \d\.\d\d px.*0\.5 px"):
        estimate_pose(scattered, BOARD, CAMERA, 0.5)


def test_a_row_of_corners_gone_astray_is_too_much() -> None:
    corners = project(placement(0.6, tilt_x=25))
    corners[:10] += np.random.default_rng(1).normal(0, 30.0, (10, 2))
    with pytest.raises(RefusedViewError, match=r"corners fit one pose|miss the board"):
        estimate_pose(corners, BOARD, CAMERA, 0.5)


def test_a_far_board_whose_tilt_could_be_either_way_is_refused() -> None:
    corners = project(placement(3.0, tilt_x=10))
    noisy = corners + np.random.default_rng(3).normal(0, 0.1, corners.shape)
    with pytest.raises(RefusedViewError, match="two different poses"):
        estimate_pose(noisy, BOARD, CAMERA, 0.5)


def test_the_stated_deviation_of_the_plane_is_the_scatter_under_noise() -> None:
    where = placement(0.7, tilt_x=25, tilt_y=-15)
    generator = np.random.default_rng(4)
    placed, stated = [], []
    for _ in range(150):
        corners = project(where) + generator.normal(0, 0.08, (35, 2))
        pose = estimate_pose(corners, BOARD, CAMERA, 1.0)
        placed.append(where.normal @ pose.centre(BOARD) + where.offset)
        stated.append(pose.plane_deviation)
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
    low, high = np.array([-margin, -margin]), np.array([4 + margin, 6 + margin])
    edges = [(low, (high[0], low[1])), ((high[0], low[1]), high)]
    edges += [(high, (low[0], high[1])), ((low[0], high[1]), low)]
    outline = np.concatenate([np.array(a) + side * (np.array(b) - a) for a, b in edges])
    points = np.concatenate([outline * BOARD.square_length, np.zeros((len(outline), 1))], 1)
    polygon = project(where, points=points).astype(np.float32)[:, None]
    return np.array(
        [
            [cv2.pointPolygonTest(polygon, (float(u), float(v)), True) for u in range(320)]
            for v in range(240)
        ]
    )


def test_a_board_behind_the_camera_is_nowhere_in_the_image() -> None:
    where = placement(0.5, tilt_x=30)
    pose = estimate_pose(project(where), BOARD, CAMERA, 0.5)
    assert not pose.area(BOARD, -rays(CAMERA), 1.0).any()


def test_true_distance_runs_along_the_ray_to_the_plane() -> None:
    where = placement(0.5, tilt_x=30)
    pose = estimate_pose(project(where), BOARD, CAMERA, 0.5)
    directions = rays(CAMERA)[100:110, 100:110].reshape(-1, 3)
    points = pose.distance(directions)[:, None] * directions
    np.testing.assert_allclose(points @ where.normal + where.offset, 0, atol=1e-6)
