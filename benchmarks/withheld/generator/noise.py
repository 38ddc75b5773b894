"""What chance adds: photons, heavy tails, a robot that does not stop where it says."""

from dataclasses import dataclass

import numpy as np

from benchmarks.withheld.generator.rigid import Array, small_motions

READ_NOISE = 45.0  # electrons
POSE_NOISE = (0.3e-3, 0.3e-3)  # metres, radians, each axis


@dataclass(frozen=True)
class Noise:
    """A kind of noise, with the tails of a t distribution of `tail` degrees of freedom."""

    tail: float = 7.0
    bursts: float = 0.0  # share of pixels hit by ten times the noise
    jitter: float = 0.0  # metres added however strong the signal is
    rows: float = 0.0  # metres shared by a row of a frame
    pose_scale: float = 1.0
    pose_tail: float = np.inf


NOISES = {
    "usual": Noise(),
    "tails": Noise(tail=2.6),
    "bursts": Noise(bursts=0.01),
    "jitter": Noise(jitter=8e-3),
    "rows": Noise(rows=2e-3),
    "poses": Noise(pose_scale=2.0, pose_tail=2.6),
}


def noisy_taps(
    rng: np.random.Generator, taps: Array, noise: Noise, metres_per_radian: float
) -> Array:
    """Add noise to correlation samples (4, N, H, W) in electrons."""
    sigma = np.sqrt(taps + READ_NOISE**2)
    if noise.jitter:
        size = np.hypot(taps[0] - taps[2], taps[3] - taps[1]) / 2
        sigma = np.hypot(sigma, np.sqrt(2) * size * noise.jitter / metres_per_radian)
    if noise.bursts:
        sigma = sigma * np.where(rng.uniform(size=taps.shape[1:]) < noise.bursts, 10.0, 1.0)
    return taps + sigma * _standard(rng, taps.shape, noise.tail)


def distance_sigma(taps: Array, metres_per_radian: float) -> Array:
    """Standard deviation (N, H, W), metres, that photons and reading give the distance.

    To first order, from correlation samples (4, N, H, W) in electrons, without jitter and bursts.
    """
    variance = taps + READ_NOISE**2
    real, imaginary = (taps[0] - taps[2]) / 2, (taps[3] - taps[1]) / 2
    across = (variance[0] + variance[2]) * imaginary**2 + (variance[1] + variance[3]) * real**2
    return metres_per_radian * np.sqrt(across) / (2 * (real**2 + imaginary**2))


def row_noise(rng: np.random.Generator, noise: Noise, shape: tuple[int, ...]) -> Array:
    """Distance noise (N, H, 1) in metres that the pixels of a row share."""
    return noise.rows * rng.standard_normal((*shape[:2], 1)) if noise.rows else np.zeros((1, 1, 1))


def pose_noise(rng: np.random.Generator, noise: Noise, pose_id: np.ndarray) -> Array:
    """Transforms (N, 4, 4) from the true to the stated tool pose; the same for repeated frames."""
    draw = noise.pose_scale * _standard(rng, (2, pose_id[-1] + 1, 3), noise.pose_tail)
    return small_motions(POSE_NOISE[0] * draw[0], POSE_NOISE[1] * draw[1])[pose_id]


def _standard(rng: np.random.Generator, shape: tuple[int, ...], tail: float) -> Array:
    """Draws of unit variance, normal or from a t distribution."""
    if np.isinf(tail):
        return rng.standard_normal(shape)
    return rng.standard_t(tail, shape) * np.sqrt((tail - 2) / tail)
