"""Normals that point away from the camera."""

from types import SimpleNamespace
from typing import cast

import numpy as np

from tofcorr.plausibility.alignment import Alignment
from tofcorr.plausibility.checks.geometry import normals
from tofcorr.plausibility.look import Look


def test_only_a_plane_with_the_camera_behind_it_is_turned() -> None:
    # Of a frame that was saturated but for a corner, noisy pixels gave a plane 147 degrees off.
    planes = np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]]), np.array([1.0, -1.0])
    found = Alignment(np.eye(4), 0.0, 0.0, np.zeros(2), np.radians([147.0, 180.0]), 1.0)
    scene = SimpleNamespace(planes_in_tool=lambda: planes)
    look = SimpleNamespace(as_given=found, planes="known", scene=scene, frames=np.array([13, 21]))
    (one,) = normals(cast("Look", look))
    assert one.frames == (21,)
