"""The standard deviation of the noise of each pixel, as a function of its brightness."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from tofcorr.diagnosis.sums.observations import Observations

# Noise at which a pixel's weight in a mean square in millimetres has fallen to a half, metres.
# Chosen: the gaps of interest are a few millimetres, and noisier pixels cannot show them.
_HALF_WEIGHT_SIGMA = 0.005
# Below the darkest knot the noise is extrapolated over this range of log brightness, a factor of
# e^3 = 20. Beyond it stays constant, so that pixels without signal get no absurd value.
_EXTRAPOLATED_LOG_RANGE = 3.0
# Exponent of sigma ~ brightness^-0.5 for shot noise: the steepest extrapolation allowed.
_SHOT_NOISE_SLOPE = 0.5


@dataclass(frozen=True, kw_only=True)
class PixelNoise:
    """Noise of a pixel: a curve over its brightness, times one factor a frame.

    The factor describes what differs between frames, such as background light.

    Attributes:
        knots: Logarithms of the brightness (`brightness_of`), increasing, shape (B,).
        sigma: Standard deviation at the knots, shape (B,), metres.
        factor: Of every frame, shape (F,).
        floor: Root mean square noise of the chosen pixels, metres.
        repeats: Number of frames taken without moving that the floor comes from. 0: the floor comes
            from differences between neighbouring pixels, and is an upper bound.
    """

    knots: np.ndarray
    sigma: np.ndarray
    factor: np.ndarray
    floor: float
    repeats: int

    def at(self, brightness: Tensor, frame: Tensor) -> Tensor:
        """Return the standard deviation of pixels of this brightness and frame, (M,), metres."""
        return torch.from_numpy(self.at_numpy(brightness.numpy(), frame.numpy()))

    def at_numpy(self, brightness: np.ndarray, frame: np.ndarray) -> np.ndarray:
        """Return the same for NumPy arrays (M,)."""
        at = np.log(np.maximum(brightness, 1e-12))
        curve = np.interp(at, self.knots, np.log(self.sigma))
        darker = np.clip(self.knots[0] - at, 0.0, _EXTRAPOLATED_LOG_RANGE)
        return np.exp(curve + self._slope() * darker) * self.factor[frame]

    def times(self, level: float) -> "PixelNoise":
        """Return the noise that is larger by a factor everywhere."""
        return replace(self, sigma=level * self.sigma, floor=level * self.floor)

    def _slope(self) -> float:
        """Return how fast log sigma rises below the darkest knot, from the darkest four."""
        if len(self.knots) < 4:
            return 0.0
        rise = np.log(self.sigma[0] / self.sigma[3]) / max(self.knots[3] - self.knots[0], 1e-9)
        return float(np.clip(rise, 0.0, _SHOT_NOISE_SLOPE))


def brightness_of(observations: Observations) -> Tensor:
    """Return what the noise depends on, shape (M,): amplitude, or 1 / distance^2 without it."""
    if observations.amplitude is not None:
        return observations.amplitude
    return 1.0 / observations.measured.clamp(min=1e-3) ** 2


def gap_weight(sigma: Tensor) -> Tensor:
    """Return the weight of pixels of this noise (M,) in a gap in millimetres, 0 to 1."""
    return 1 / (1 + (sigma / _HALF_WEIGHT_SIGMA) ** 2)
