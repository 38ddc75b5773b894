"""Depth of a PyBullet scene as a Kinect v2 would measure it: `python pybullet_depth.py [OUT.npz]`.

Needs tofcorr and pybullet. With a file, writes rendered and measured depth.
"""

import sys

import numpy as np
import pybullet
import torch

import tofcorr

NEAR, FAR = 0.3, 4.0


def box_on_floor(width: int, height: int, focal: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Render a box on a floor; return depth along the optical axis, metres, and reflectivity."""
    client = pybullet.connect(pybullet.DIRECT)
    floor = pybullet.createCollisionShape(pybullet.GEOM_BOX, halfExtents=[3, 3, 0.01])
    box = pybullet.createCollisionShape(pybullet.GEOM_BOX, halfExtents=[0.15, 0.15, 0.15])
    pybullet.createMultiBody(0, floor, basePosition=[0, 0, -0.01])
    cube = pybullet.createMultiBody(0, box, basePosition=[0, 0, 0.15])
    view = pybullet.computeViewMatrix([0.85, -0.5, 0.75], [0, 0, 0.15], [0, 0, 1])
    field = np.degrees(2 * np.arctan(height / (2 * focal)))
    projection = pybullet.computeProjectionMatrixFOV(field, width / height, NEAR, FAR)
    _, _, _, buffer, bodies = pybullet.getCameraImage(
        width, height, view, projection, renderer=pybullet.ER_TINY_RENDERER
    )
    pybullet.disconnect(client)
    buffer, bodies = (np.reshape(image, (height, width)) for image in (buffer, bodies))
    depth = FAR * NEAR / (FAR - (FAR - NEAR) * buffer)  # From OpenGL's buffer to metres.
    depth = np.where(depth < 0.999 * FAR, depth, np.nan)
    reflectivity = np.where(bodies == cube, 0.7, 0.35)
    return torch.from_numpy(depth).float(), torch.from_numpy(reflectivity).float()


def main() -> None:
    """Render and measure."""
    sensor = tofcorr.SensorModel.load("kinect_v2")
    camera = sensor.sensor.intrinsics()
    depth, reflectivity = box_on_floor(camera.width, camera.height, camera.matrix[0][0])
    with torch.inference_mode():
        measured = sensor(
            depth, reflectivity=reflectivity, generator=torch.Generator().manual_seed(1)
        )
    error = (measured.depth - depth)[measured.valid] * 1e3
    print(f"mean error {error.mean():.1f} mm, standard deviation {error.std():.1f} mm")
    print(f"{1 - measured.valid.sum() / depth.isfinite().sum():.1%} of the pixels are not valid")
    if len(sys.argv) > 1:
        np.savez(sys.argv[1], rendered=depth, measured=measured.depth)


if __name__ == "__main__":
    main()
