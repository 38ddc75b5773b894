"""Corners are found where they are."""

import numpy as np
import pytest
from importing.checkerboard.rendered_board import BOARD, Placement, infrared, placement, project
from optional import present

FRONTAL, FAR = placement(0.5), placement(0.9, tilt_y=-30, aside=(0.1, 0.05))
TILTED, NEAR = placement(0.6, tilt_x=35, roll=20), placement(0.4, tilt_x=-25, tilt_y=25, roll=80)


@pytest.mark.parametrize("where", [FRONTAL, FAR, TILTED, NEAR])
def test_corners_are_found_to_a_tenth_of_a_pixel(where: Placement) -> None:
    found = present(BOARD.find(infrared(where)))
    # The board looks the same after half a turn.
    both = (np.linalg.norm(one - project(where), axis=1) for one in (found, found[::-1]))
    errors = min(both, key=np.sum)
    assert np.sqrt((errors**2).mean()) < 0.1
    assert errors.max() < 0.25


def test_a_board_lit_from_one_side_only_is_found() -> None:
    falloff = np.geomspace(1.0, 0.01, 320)
    assert BOARD.find((infrared(TILTED) * falloff).astype(np.uint16)) is not None
