"""The standard deviation of the noise of each pixel, as a function of its brightness."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from tofcorr.diagnosis.sums.observations import Observations

# Noise at which a pixel's weight in a mean square in millimetres has fallen to a half, metres.
# Chosen: the gaps of interest are a few millimetres, and noisier pixels cannot show them.
_HALF_WEIGHT_SIGMA = 0.005


class RepeatedNoise(NamedTuple):
    """What repeated frames say of the noise, each over what differences between neighbours say.

    Attributes:
        frames: Number of repeated frames; 0: they say nothing.
        least: Root mean square, with the weakest filter over time that they do not exclude; with
            none where no pose has three.
        ratio: With the filter that the frames show; infinite where no pose has three: any filter
            is possible.
        most: With the strongest filter that they do not exclude.
        error: Relative error of all three by how much poses differ, two standard errors; 0 of a
            single pose.
    """

    frames: int
    least: float
    ratio: float
    most: float
    error: float = 0.0

    @property
    def finite_ratio(self) -> float:
        """What is assumed before more is known."""
        return self.ratio if np.isfinite(self.ratio) else max(self.least, 1.0)


NO_REPEATS = RepeatedNoise(frames=0, least=1.0, ratio=1.0, most=1.0)


@dataclass(frozen=True, kw_only=True)
class PixelNoise:
    """Noise of a pixel: a curve over its brightness, times one factor a frame.

    The factor describes what differs between frames, such as background light.

    Attributes:
        knots: Logarithms of the brightness (`brightness_of`), increasing, shape (B,).
        sigma: Standard deviation at the knots, shape (B,), metres.
        factor: Of every frame, shape (F,).
        repeated: What frames taken without moving say. Without them the level comes from
            differences between neighbouring pixels, and is an upper bound.
        error: Relative error of what differences between neighbours say, two standard errors.
        least, most: Smallest and largest noise that is possible, over this one.
    """

    knots: np.ndarray
    sigma: np.ndarray
    factor: np.ndarray
    repeated: RepeatedNoise = NO_REPEATS
    error: float = 0.0
    least: float = 1.0
    most: float = 1.0

    @property
    def repeats(self) -> int:
        """Number of frames taken without moving that the level comes from."""
        return self.repeated.frames

    def at(self, brightness: Tensor, frame: Tensor) -> Tensor:
        """Return the standard deviation of pixels of this brightness and frame, (M,), metres."""
        return torch.from_numpy(self.at_numpy(brightness.numpy(), frame.numpy()))

    def at_numpy(self, brightness: np.ndarray, frame: np.ndarray) -> np.ndarray:
        """Return the same for NumPy arrays (M,)."""
        at = np.log(np.maximum(brightness, 1e-12))
        return np.exp(np.interp(at, self.knots, np.log(self.sigma))) * self.factor[frame]

    def limits(self, level: float) -> tuple[float, float, float]:
        """Return the least, likeliest and largest noise over what neighbours' differences see.

        They see all of it but what neighbours share, and fine structure too. Without repeats what
        neighbours share may be structure. Repeats do not see what a filter over time leaves alike.
        Where they say more than neighbours allow, either may be right.

        Args:
            level: Noise over what those differences see of it, where neighbours share some.
        """
        repeated, bound = self.repeated, level * (1 + self.error)
        if not repeated.frames:
            return 1 - self.error, level, bound
        seen = bool(np.isfinite(repeated.ratio))
        ratio = max(min(repeated.ratio, bound if seen else level), repeated.least)
        most = min(repeated.most * (1 + repeated.error), bound)
        most = max(most, ratio, repeated.ratio if seen else 0.0)
        return repeated.least * (1 - repeated.error), ratio, most

    def held_to_neighbours(self, level: float, striped: bool = False) -> "PixelNoise":
        """Return the noise within `limits`.

        Args:
            level: Noise over what differences between neighbours see of it.
            striped: Whether repeats differ by structure too, of which those differences see less.
        """
        kept = replace(self, repeated=NO_REPEATS) if striped else self
        least, ratio, most = kept.limits(level)
        sigma = ratio / self.repeated.finite_ratio * self.sigma
        return replace(kept, sigma=sigma, least=least / ratio, most=most / ratio)


def brightness_of(observations: Observations) -> Tensor:
    """Return what the noise depends on, shape (M,): amplitude, or 1 / distance^2 without it."""
    if observations.amplitude is not None:
        return observations.amplitude
    return 1.0 / observations.measured.clamp(min=1e-3) ** 2


def gap_weight(sigma: Tensor) -> Tensor:
    """Return the weight of pixels of this noise (M,) in a gap in millimetres, 0 to 1."""
    return 1 / (1 + (sigma / _HALF_WEIGHT_SIGMA) ** 2)
