"""PyBullet's own renderer as the simulator: the z-buffer of its software rasteriser, converted."""

from dataclasses import replace
from importlib.util import find_spec

import numpy as np

from benchmarks.withheld.generator.camera import Camera
from benchmarks.withheld.generator.recording import Recorded
from benchmarks.withheld.generator.rigid import Array, inverse, quaternions

NEAR, FAR = 0.1, 8.0  # metres, clipping planes: a scene ends before 5 m
WALL_HALF = (6.0, 6.0, 0.05)  # metres; wider than any view
OPEN_GL = np.diag([1.0, -1.0, -1.0, 1.0])  # its camera looks along -z, with y upwards


def missing() -> str:
    """Why PyBullet cannot render here; empty where it can."""
    return "" if find_spec("pybullet") else "PyBullet is not installed: pip install '.[bench]'"


def rendered(one: Recorded) -> Recorded:
    """The recording with PyBullet's depth of a plain wall in place of the target.

    Raises:
        RuntimeError: PyBullet is not installed.
    """
    if reason := missing():
        raise RuntimeError(reason)
    import pybullet

    setup = one.world.setup
    camera_from_world = inverse(one.stated_poses @ setup.tool_from_camera)
    client = pybullet.connect(pybullet.DIRECT)
    try:
        _stand_wall(setup.world_from_target)
        z = np.stack([_z_depth(setup.camera, view) for view in camera_from_world])
    finally:
        pybullet.disconnect(client)
    return replace(
        one, depth=np.where(z < FAR * (1 - 1e-6), z / setup.camera.rays()[..., 2], np.nan)
    )


def _stand_wall(world_from_target: Array) -> None:
    """Stand a wall whose face is the target's plane z = 0."""
    import pybullet

    shape = pybullet.createVisualShape(pybullet.GEOM_BOX, halfExtents=WALL_HALF)
    centre = world_from_target @ np.array([0.0, 0.0, -WALL_HALF[2], 1.0])
    turn = quaternions(world_from_target[None, :3, :3])[0]
    pybullet.createMultiBody(0, -1, shape, basePosition=centre[:3], baseOrientation=turn)


def _z_depth(camera: Camera, camera_from_world: Array) -> Array:
    """Depth (H, W) along the optical axis, metres, of one image."""
    import pybullet

    view, projection = OPEN_GL @ camera_from_world, _projection(camera)
    buffer = pybullet.getCameraImage(
        camera.width,
        camera.height,
        view.T.ravel().tolist(),
        projection.T.ravel().tolist(),
        renderer=pybullet.ER_TINY_RENDERER,
    )[3]
    share = np.asarray(buffer, dtype=float).reshape(camera.height, camera.width)
    return FAR * NEAR / (FAR - (FAR - NEAR) * share)


def _projection(camera: Camera) -> Array:
    """OpenGL's projection matrix (4, 4).

    The rasteriser samples a pixel at its lower left corner, hence no half pixel across and a whole
    one down; a tilted wall's z-buffer then agrees with geometry to 0.003 mm.
    """
    width, height = camera.width, camera.height
    matrix = np.zeros((4, 4))
    matrix[0, 0], matrix[1, 1] = 2 * camera.focal[0] / width, 2 * camera.focal[1] / height
    matrix[0, 2] = 1 - 2 * camera.centre[0] / width
    matrix[1, 2] = 2 * (camera.centre[1] + 1) / height - 1
    matrix[2, 2], matrix[2, 3] = -(FAR + NEAR) / (FAR - NEAR), -2 * FAR * NEAR / (FAR - NEAR)
    matrix[3, 2] = -1.0
    return matrix
