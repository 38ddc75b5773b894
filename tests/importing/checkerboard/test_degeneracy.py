"""What a board cannot tell apart, as the importer warns: 1 % of a length is 10 mm/m of a slope."""

from dataclasses import replace

import numpy as np
import pytest
from importing.checkerboard.rendered_board import BOARD, CAMERA, centre, placement, project

from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.importing.checkerboard.boards import Board, poses_of

LARGER = BOARD.model_copy(update={"square_length": 1.01 * BOARD.square_length})
(FX, _, CX), (_, FY, CY), LAST = CAMERA.matrix
LONGER = replace(CAMERA, matrix=((1.01 * FX, 0.0, CX), (0.0, 1.01 * FY, CY), LAST))


@pytest.mark.parametrize(
    ("board", "camera", "worse", "exact"),
    [(LARGER, CAMERA, 1e-4, 1e-4), (BOARD, LONGER, 0.5, 2e-3)],
)
def test_larger_squares_and_a_longer_focal_length_hide_in_the_slope(
    board: Board, camera: CameraIntrinsics, worse: float, exact: float
) -> None:
    generator = np.random.default_rng(6)
    every = np.ones(35, dtype=bool)
    for i, distance in enumerate(np.linspace(0.4, 0.9, 10)):
        where = placement(distance, tilt_x=20 * (-1) ** i, tilt_y=15)
        corners = project(where) + generator.normal(0, 0.05, (35, 2))
        given = poses_of(corners, BOARD, CAMERA, every)[0]
        other = poses_of(corners, board, camera, every)[0]
        assert other.reprojection_rms < (1 + worse) * given.reprojection_rms
        farther = centre(other, board)[2] / centre(given, BOARD)[2]
        assert farther == pytest.approx(1.01, abs=exact)
