"""Which pixels are said to look at the target: exactly, or as a plane fit finds them."""

import numpy as np

from benchmarks.renewed.generator.measure import Measured
from benchmarks.withheld.generator.rigid import Array

UNERODED = "RANSAC, no margin"  # with the pixels at edges, for effects that live there
TRIALS = 40
SAMPLE = 400  # pixels on which a trial is judged
MOST_EMPTY = 20  # pixels in the region marked: with fewer the frame is left out
NOISE_TIMES = 3.0  # the threshold is at least so many times the scatter


def mask_of(
    rng: np.random.Generator, seen: Measured, depth: Array, kind: str, threshold: float
) -> np.ndarray:
    """The mask (N, H, W) of measured depths with NaN where nothing returned."""
    if kind == "all that is seen":
        return seen.view.on_target
    if kind.startswith("RANSAC"):
        margin = 0 if kind == UNERODED else 2
        rays = _rays(seen)
        found = [
            _plane_pixels(rng, rays * image[..., None], about, threshold)
            for image, about in zip(depth, seen.view.on_target, strict=True)
        ]
        return np.stack([_eroded(image, margin) for image in found]) & seen.view.within
    return np.stack([_eroded(image, 2) for image in seen.view.on_target])


def _rays(seen: Measured) -> Array:
    x, y = seen.view.world.sensor.lens.slopes()
    rays = np.stack([x, y, np.ones_like(x)], axis=-1)
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


def _plane_pixels(
    rng: np.random.Generator, points: Array, about: np.ndarray, threshold: float
) -> np.ndarray:
    """Pixels (H, W) within the threshold of the plane that most of a marked region agrees with.

    The region keeps the search from the wall behind a board; the pixels found may lie anywhere.
    """
    known = np.isfinite(points).all(-1)
    if (known & about).sum() < MOST_EMPTY:
        return np.zeros_like(known)
    cloud = points[known & about]
    few = cloud[rng.integers(len(cloud), size=SAMPLE)]
    best, most = (np.array([0.0, 0.0, 1.0]), 0.0), -1
    for _ in range(TRIALS):
        a, b, c = few[rng.integers(SAMPLE, size=3)]
        normal = np.cross(b - a, c - a)
        if not (length := np.linalg.norm(normal)):
            continue
        plane = normal / length, float(normal @ a / length)
        count = int((np.abs(few @ plane[0] - plane[1]) < threshold).sum())
        if count > most:
            best, most = plane, count
    normal, offset = _refined(cloud, *best, threshold)
    off = np.abs(np.nan_to_num(points) @ normal - offset)
    scatter = 1.48 * np.median(off[known & (off < threshold)])
    return known & (off < max(threshold, NOISE_TIMES * scatter))


def _refined(cloud: Array, normal: Array, offset: float, threshold: float) -> tuple[Array, float]:
    for _ in range(2):
        near = cloud[np.abs(cloud @ normal - offset) < threshold]
        if len(near) < 10:
            break
        middle = near.mean(0)
        normal = np.linalg.eigh((near - middle).T @ (near - middle))[1][:, 0]
        offset = float(normal @ middle)
    return normal, offset


def _eroded(mask: np.ndarray, pixels: int) -> np.ndarray:
    """The mask without its rim, counting neighbours along rows and columns."""
    for _ in range(pixels):
        inner = mask.copy()
        inner[1:] &= mask[:-1]
        inner[:-1] &= mask[1:]
        inner[:, 1:] &= mask[:, :-1]
        inner[:, :-1] &= mask[:, 1:]
        mask = inner
    return mask
