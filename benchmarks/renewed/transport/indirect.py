"""Indirect over direct light of a whole recording, at its modulation frequencies."""

import hashlib
from collections.abc import Sequence

import numpy as np

from benchmarks.renewed.transport.cache import cached
from benchmarks.renewed.transport.histograms import Renderer
from benchmarks.renewed.transport.rooms import Room

SAMPLES = 2048  # paths a point: leaves 3 % of the indirect light as noise, before `smooth`
DEGREE = 4  # of the polynomial over the image that takes off the noise


def indirect(
    room: Room, cameras: np.ndarray, points: np.ndarray, frequencies: Sequence[float], seed: int
) -> np.ndarray:
    """Phasors (F, N, R, C) of indirect light over direct light.

    Args:
        room: What stands around the target.
        cameras: target_from_camera (N, 4, 4).
        points: Where each camera looks, on the target (N, R, C, 3).
        frequencies: Hz (F,).
        seed: Of the paths.
    """
    text = hashlib.sha256(cameras.tobytes() + points.tobytes()).hexdigest()
    key = f"1 {room} {text} {tuple(frequencies)} {seed} {SAMPLES}"
    return cached(key, lambda: _rendered(room, cameras, points, frequencies, seed))


def _rendered(
    room: Room, cameras: np.ndarray, points: np.ndarray, frequencies: Sequence[float], seed: int
) -> np.ndarray:
    renderer, result = Renderer(room), []
    for number, (camera, at) in enumerate(zip(cameras, points, strict=True)):
        light = renderer.at(camera, at.reshape(-1, 3), SAMPLES, seed + number)
        result.append([light.phasor(frequency) for frequency in frequencies])
    return np.stack(result, axis=1).reshape(len(frequencies), *points.shape[:3])


def smooth(values: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Polynomial through values (..., R, C) of an even grid, at rows (H,) and columns (W,).

    Positions go from -1 to 1. Indirect light varies slowly; the noise of its paths does not.
    """
    high, wide = values.shape[-2:]
    down, along = np.meshgrid(np.linspace(-1, 1, high), np.linspace(-1, 1, wide), indexing="ij")
    fit = np.linalg.pinv(_terms(down.ravel(), along.ravel()))
    v, u = np.meshgrid(rows, columns, indexing="ij")
    weights = _terms(v.ravel(), u.ravel()) @ fit
    result = values.reshape(*values.shape[:-2], -1) @ weights.T
    return result.reshape(*values.shape[:-2], len(rows), len(columns))


def _terms(v: np.ndarray, u: np.ndarray) -> np.ndarray:
    return np.stack(
        [v**i * u**j for i in range(DEGREE + 1) for j in range(DEGREE + 1 - i)], axis=-1
    )
