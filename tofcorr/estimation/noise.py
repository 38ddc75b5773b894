r"""The noise of a measured distance, as a function of its amplitude.

.. math:: \sigma^2(A) = a + b / A + c / A^2

Shot noise of the signal itself falls with 1/A, that of background light and the readout with
1/A^2 (a phase is the angle of a vector of length A); the rest, a, does not depend on A.
"""

from typing import Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from tofcorr.errors import CalibrationDataError
from tofcorr.spread import sigma_from_mad

Source = Literal["repeats", "neighbours"]

# Bins of amplitude, of equal count. Set by hand: eight for each of the three numbers fitted.
_BINS = 24
# Fewest differences in a bin: the standard deviation of 20 is known to about 16 % (1 / sqrt(2 n)),
# from their median absolute deviation to about 26 %. Set by hand.
_FEWEST_PER_BIN = 20
# Largest ratio of the amplitudes of three neighbours that count as equally bright. Set by hand.
_ALIKE = 1.2


class DistanceNoise(NamedTuple):
    """Variance of a measured distance along its ray.

    Attributes:
        floor: a, square metres.
        shot: b, square metres times the amplitude's unit.
        readout: c, square metres times the amplitude's unit squared.
        source: `repeats`: frames taken without moving; `neighbours`: pixels side by side in one
            image, an upper bound, because their fixed pattern counts as noise.
    """

    floor: float
    shot: float
    readout: float
    source: Source

    def variance(self, amplitude: Float[Tensor, "*pixels"]) -> Float[Tensor, "*pixels"]:
        """Return the variance at amplitudes (...), square metres; infinite at zero amplitude."""
        inverse = 1 / amplitude.clamp(min=0)
        variance = torch.full_like(amplitude, self.floor)
        if self.shot:
            variance = variance + self.shot * inverse
        if self.readout:
            variance = variance + self.readout * inverse.square()
        return variance

    @property
    def coefficients(self) -> tuple[float, float, float]:
        """a, b and c."""
        return self.floor, self.shot, self.readout

    def to_mapping(self) -> dict[str, float | str]:
        """Return plain values, for reports."""
        return self._asdict()


def fit_noise(
    differences: Float[Tensor, "S"], amplitude: Float[Tensor, "S"], source: Source
) -> DistanceNoise:
    """Fit a, b and c to differences of two measurements of the same distance.

    In each of two dozen bins of amplitude the variance comes from the median absolute deviation, so
    that gross outliers do not count.

    Args:
        differences: Of two distances with independent noise, shape (S,), metres.
        amplitude: Their mean amplitude, shape (S,).
        source: Where they come from.

    Raises:
        CalibrationDataError: There are too few, or most are zero.
    """
    usable = torch.isfinite(differences) & torch.isfinite(amplitude) & (amplitude > 0)
    differences, amplitude = differences[usable], amplitude[usable]
    if len(differences) < _FEWEST_PER_BIN:
        raise CalibrationDataError(
            f"The noise cannot be estimated: {len(differences)} usable differences of pixels, "
            f"{_FEWEST_PER_BIN} are needed."
        )
    order = amplitude.argsort()
    bins = [part for part in order.tensor_split(_BINS) if len(part) >= _FEWEST_PER_BIN]
    bins = bins or [order]
    centre = np.array([float(amplitude[part].median()) for part in bins])
    spread = [
        sigma_from_mad(float((differences[part] - differences[part].median()).abs().median()))
        for part in bins
    ]
    variance = np.square(spread) / 2
    if not variance.min() > 0:
        raise CalibrationDataError(
            "The noise cannot be estimated: most pixels repeat exactly. Are the distances rounded, "
            "or copies of one frame?"
        )
    columns = np.stack([np.ones_like(centre), 1 / centre, 1 / centre**2], axis=1)
    floor, shot, readout = nonnegative_coefficients(columns, variance).tolist()
    return DistanceNoise(floor, shot, readout, source)


def nonnegative_coefficients(columns: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """Fit variances by a sum of columns, none of which may be subtracted.

    Relative deviations count: the uncertainty of a bin's variance is proportional to it.

    Args:
        columns: What the variance is a sum of, shape (B, K), not negative.
        variance: Variance of each bin, shape (B,), positive.

    Returns:
        Factors of the columns, shape (K,), not negative.
    """
    from scipy.optimize import nnls  # Takes a quarter of the time of torch to import.

    scale = columns.max(axis=0)
    return nnls(columns / scale / variance[:, None], np.ones_like(variance))[0] / scale


def neighbour_differences(
    radial_distance: Float[Tensor, "B H W"],
    amplitude: Float[Tensor, "B H W"],
    valid: Bool[Tensor, "B H W"],
    ray_directions: Float[Tensor, "H W 3"],
) -> tuple[Float[Tensor, "S"], Float[Tensor, "S"]]:
    """Return differences of pixels side by side that are about equally bright.

    On a plane 1/z is linear in the pixel, so that the second difference of three neighbours is
    noise, whatever the tilt.

    Args:
        radial_distance: Shape (B, H, W), metres.
        amplitude: Shape (B, H, W).
        valid: Where a pixel may be used, shape (B, H, W).
        ray_directions: Unit rays, shape (H, W, 3).

    Returns:
        Differences, scaled to the variance of the difference of two distances, metres, and mean
        amplitudes, each (S,).
    """
    z_of_ray = ray_directions[..., 2].to(radial_distance)
    inverse = 1 / (radial_distance * z_of_ray)
    second = inverse[..., :-2] - 2 * inverse[..., 1:-1] + inverse[..., 2:]
    # A change dD of the distance changes 1/z by dD z_of_ray / z^2.
    along_ray = second * (radial_distance.square() * z_of_ray)[..., 1:-1]
    around = torch.stack([amplitude[..., :-2], amplitude[..., 1:-1], amplitude[..., 2:]])
    usable = valid[..., :-2] & valid[..., 1:-1] & valid[..., 2:]
    chosen = usable & (around.amax(dim=0) < _ALIKE * around.amin(dim=0))
    # A second difference has six variances, the difference of two distances has two.
    return along_ray[chosen] / 3**0.5, around.mean(dim=0)[chosen]
