"""Depth of a PyBullet scene as a Kinect v2 would measure it: `python pybullet_depth.py [OUT.png]`.

Needs tofcorr and pybullet. Prints the processor time of a frame; with a file, draws the frame.
"""

import sys
import time

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
    eye, target, up = [0.85, -0.5, 0.75], [0, 0, 0.15], [0, 0, 1]
    view = pybullet.computeViewMatrix(eye, target, up)
    field = np.degrees(2 * np.arctan(height / (2 * focal)))
    projection = pybullet.computeProjectionMatrixFOV(field, width / height, NEAR, FAR)
    _, _, _, buffer, bodies = pybullet.getCameraImage(
        width, height, view, projection, renderer=pybullet.ER_TINY_RENDERER
    )
    pybullet.disconnect(client)
    shape = (height, width)
    depth = FAR * NEAR / (FAR - (FAR - NEAR) * np.reshape(buffer, shape))  # From OpenGL's buffer.
    seen = depth < 0.999 * FAR
    reflectivity = np.where(np.reshape(bodies, shape) == cube, 0.7, 0.35)
    depth = np.where(seen, depth, np.nan)
    return torch.from_numpy(depth).float(), torch.from_numpy(reflectivity).float()


def main() -> None:
    """Render, measure, and say how long it took."""
    sensor = tofcorr.SensorModel.load("kinect_v2")
    camera = sensor.sensor.intrinsics()
    depth, reflectivity = box_on_floor(camera.width, camera.height, camera.matrix[0][0])
    generator = torch.Generator().manual_seed(1)
    torch.set_num_threads(1)
    frames = 30
    with torch.inference_mode():
        measured = sensor(depth, reflectivity=reflectivity, generator=generator)
        started = time.process_time()
        for _ in range(frames):
            measured = sensor(depth, reflectivity=reflectivity, generator=generator)
        spent = (time.process_time() - started) / frames
    error = (measured.depth - depth)[measured.valid] * 1e3
    print(f"{1e3 * spent:.1f} ms of processor time a frame of {camera.width}x{camera.height}")
    print(f"mean error {error.mean():.1f} mm, standard deviation {error.std():.1f} mm")
    print(f"{1 - measured.valid.sum() / depth.isfinite().sum():.1%} of the pixels are not valid")
    if len(sys.argv) > 1:
        draw(depth, measured.depth, sys.argv[1])


def draw(ideal: torch.Tensor, measured: torch.Tensor, file: str) -> None:
    """Draw ideal and degraded depth, and their difference."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 3, figsize=(13, 3.4), layout="constrained")
    error = 1e3 * (measured - ideal)
    low, high = np.nanmin(ideal.numpy()), np.nanmax(ideal.numpy())
    images = (
        ("rendered depth, m", ideal, low, high, "viridis"),
        ("as the camera measures it, m", measured, low, high, "viridis"),
        ("measured - rendered, mm", error, -40.0, 40.0, "RdBu_r"),
    )
    for axis, (title, image, least, most, colours) in zip(axes, images, strict=True):
        colour_map = plt.get_cmap(colours).with_extremes(bad="black")
        shown = axis.imshow(image.numpy(), vmin=least, vmax=most, cmap=colour_map)
        axis.set_title(title, loc="left", fontsize=11)
        axis.set_axis_off()
        figure.colorbar(shown, ax=axis, shrink=0.85)
    figure.savefig(file, dpi=110)


if __name__ == "__main__":
    main()
