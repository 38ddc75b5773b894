r"""The noise of a measured distance: its law, how it is fitted, and what pixels and frames share.

.. math:: \sigma^2(A) = a + b / A + c / A^2

Shot noise of the signal itself falls with 1/A, that of background light and the readout with
1/A^2 (a phase is the angle of a vector of length A); the rest, a, does not depend on A. With a
reference amplitude A0, :math:`\sigma^2 = f^2 + s^2 A_0 / A + r^2 (A_0 / A)^2`. Light falls with the
square of the distance: without amplitude, A0/A is (D/D0)^2, so that s belongs to a part of sigma
linear in the distance, and r to a quadratic one.

*Neighbours.* White noise filtered with the weights :math:`w_k = e^{-k^2/2\sigma^2}` has the
correlation :math:`\rho_L = \sum_k w_k w_{k+L} / \sum_k w_k^2` between pixels L apart in a row or
column.

*Frames.* A camera that averages frames filters in time. Its frame is
:math:`n_t = \rho n_{t-1} + \sqrt{1 - \rho^2}\, e_t`. Frames k apart differ by
:math:`\sigma^2 (1 - \rho^k)` in half squares, so that those of two steps are :math:`1 + \rho` times
those of one, whatever the noise is.
"""

from collections.abc import Sequence
from typing import Annotated, Literal, NamedTuple, TypeVar

import numpy as np
import torch
from jaxtyping import Bool, Float
from pydantic import Field
from torch import Tensor

from tofcorr.errors import CalibrationDataError
from tofcorr.estimation.robust import robust_scale
from tofcorr.options import NonNegativeNumber, Number, Options, PositiveNumber, Share

ArrayT = TypeVar("ArrayT", np.ndarray, Tensor)
Source = Literal["repeats", "neighbours"]
"""`repeats`: frames taken without moving; `neighbours`: differences of pixels in one image."""

SPACING = 3
"""Spacing of second differences, pixels. Cameras filter their images, so that nearer pixels share
much of their noise; over longer ones surfaces bend. Chosen."""
SAME_BRIGHTNESS = 0.25
"""Neighbours whose amplitudes differ by more than this share (no unit) are not compared: they have
different errors. Chosen."""
SECOND_DIFFERENCE = 1.5
"""Variance of x - (left + right) / 2 for independent noise of variance one: 1 + 1/4 + 1/4."""
BINS = 24
"""Most bins of brightness, of equal count: eight for each of the three numbers fitted. Chosen."""
# Fewest differences in a bin: the standard deviation of 20 is known to about 16 % (1 / sqrt(2 n)),
# from their median absolute deviation to about 26 %. Set by hand.
_FEWEST_PER_BIN = 20
# Largest ratio of the amplitudes of three neighbours that count as equally bright. Set by hand.
_ALIKE = 1.2
# Sides of the tiles whose scatter gives a standard error, pixels. Chosen: filters of the image
# reach less far.
_TILE = 8


class NoiseModel(Options):
    """The noise of one distance along the ray: its whole variance, and what part never changes.

    Attributes:
        floor_m: f, what brightness does not change, metres.
        shot_m: s, shot noise at the reference, metres.
        read_m: r, readout and background light at the reference, metres.
        reference_amplitude: A0, counts; null: no amplitude was recorded.
        reference_distance_m: D0, metres.
        least_brightness: Smallest A / A0 (or (D0/D)^2) measured; darker pixels get its noise.
        fixed_share: Share of the variance that is the same in every frame, pixel by pixel; the rest
            is drawn anew in each frame.
        correlation_px: Standard deviation, in pixels, of the Gaussian filter that makes white noise
            as correlated as this noise; 0: white.
        fixed_seed: Of the fixed part. The pixels of one camera are not known from its statistics:
            it is that of a camera of this kind.
    """

    floor_m: NonNegativeNumber
    shot_m: NonNegativeNumber = 0.0
    read_m: NonNegativeNumber = 0.0
    reference_amplitude: PositiveNumber | None = None
    reference_distance_m: PositiveNumber = 1.0
    least_brightness: Annotated[Number, Field(gt=0)] = 0.01
    fixed_share: Share = 0.0
    correlation_px: Annotated[Number, Field(ge=0, le=50)] = 0.0
    fixed_seed: Annotated[int, Field(ge=0)] = 1

    @property
    def needs_amplitude(self) -> bool:
        """Whether the noise depends on the amplitude."""
        return self.reference_amplitude is not None

    @property
    def deviations(self) -> tuple[float, float, float]:
        """f, s and r, metres."""
        return self.floor_m, self.shot_m, self.read_m

    def brightness(self, distance: ArrayT, amplitude: ArrayT | None = None) -> ArrayT:
        """Return A / A0, or (D0 / D)^2 without a reference amplitude, as `sigma` takes them."""
        if self.reference_amplitude is None:
            relative = (self.reference_distance_m / distance) ** 2
        elif amplitude is None:
            raise ValueError("This noise curve depends on the amplitude; none is given.")
        else:
            relative = amplitude / self.reference_amplitude
        return relative.clip(min=self.least_brightness)

    def sigma(
        self,
        distance: ArrayT,
        amplitude: ArrayT | None = None,
        deviations: Sequence[Tensor] | None = None,
    ) -> ArrayT:
        """Return the standard deviation of the whole noise, fixed and temporal.

        Args:
            distance: Radial distances, any shape, metres; read only without a reference amplitude.
            amplitude: Amplitudes of that shape, counts; needed with a reference amplitude.
            deviations: f, s and r in place of those of the model, metres; None: those.

        Returns:
            Shape of `distance`, metres.

        Raises:
            ValueError: The noise depends on the amplitude, and none is given.
        """
        darkness = 1.0 / self.brightness(distance, amplitude)
        floor, shot, read = self.deviations if deviations is None else deviations
        return (floor**2 + darkness * (shot**2 + read**2 * darkness)) ** 0.5

    def temporal_sigma(self, distance: ArrayT, amplitude: ArrayT | None = None) -> ArrayT:
        """Return the standard deviation of what changes from frame to frame, as `sigma` does."""
        return self.sigma(distance, amplitude) * (1.0 - self.fixed_share) ** 0.5

    def with_fixed_share(self, share: float) -> "NoiseModel":
        """Return the same temporal noise beside another fixed share of the whole variance."""
        factor = ((1.0 - self.fixed_share) / (1.0 - share)) ** 0.5
        names = ("floor_m", "shot_m", "read_m")
        changes = {name: getattr(self, name) * factor for name in names}
        return self.model_copy(update={**changes, "fixed_share": share})


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
        """Return the variance at amplitudes (...), square metres; beyond measure at none."""
        # The least amplitude, for zero times infinity would be NaN.
        inverse = 1 / amplitude.clamp(min=torch.finfo(amplitude.dtype).tiny)
        return self.floor + inverse * (self.shot + self.readout * inverse)


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
        few = f"{len(differences)} usable differences of {_FEWEST_PER_BIN} needed"
        raise CalibrationDataError(f"The noise cannot be estimated: {few}.")
    bins = brightness_bins(amplitude.numpy(), _FEWEST_PER_BIN)
    centre = np.array([float(amplitude[part].median()) for part in bins])
    spread = [robust_scale(differences[part] - differences[part].median()) for part in bins]
    variance = np.square(spread) / 2
    if not variance.min() > 0:
        raise CalibrationDataError("The noise is unknown: most pixels repeat. Copies of one frame?")
    floor, shot, readout = fit_law(centre[:, None] ** [0.0, -1.0, -2.0], variance).tolist()
    return DistanceNoise(floor, shot, readout, source)


def fit_law(columns: np.ndarray, variance: np.ndarray) -> np.ndarray:
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


def brightness_bins(brightness: np.ndarray, fewest: int) -> list[np.ndarray]:
    """Return the numbers of pixels in bins of like brightness and equal count, the darkest first.

    Args:
        brightness: Of the pixels, shape (M,).
        fewest: Pixels of a bin at least, if there are so many; there are 24 bins at most.
    """
    order = np.argsort(brightness, kind="stable")
    return np.array_split(order, int(np.clip(len(order) // fewest, 1, BINS)))


def neighbour_differences(
    radial_distance: Float[Tensor, "B H W"],
    amplitude: Float[Tensor, "B H W"],
    valid: Bool[Tensor, "B H W"],
    ray_directions: Float[Tensor, "H W 3"],
) -> tuple[Float[Tensor, "B H W-2"], Float[Tensor, "B H W-2"]]:
    """Return differences of pixels side by side, NaN unless they are about equally bright.

    On a plane 1/z is linear in the pixel, so that the second difference of three neighbours is
    noise, whatever the tilt.

    Args:
        radial_distance: Shape (B, H, W), metres.
        amplitude: Shape (B, H, W).
        valid: Where a pixel may be used, shape (B, H, W).
        ray_directions: Unit rays, shape (H, W, 3).

    Returns:
        Differences, scaled to the variance of the difference of two distances, metres, and mean
        amplitudes, each (B, H, W - 2).
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
    return torch.where(chosen, along_ray / 3**0.5, torch.nan), around.mean(dim=0)


# What neighbours and successive frames share.


WIDEST_PX = 5.0
"""Widest filter of the noise that is looked for, pixels. Chosen: beyond all filters of cameras."""
# Correlation of nearest neighbours below which noise counts as white. Chosen: it changes the
# variance of a mean of nine pixels by less than 5 %.
_WHITE = 0.01


def neighbour_correlation(width_px: float, lag: int) -> float:
    """Return the correlation of pixels `lag` apart after a Gaussian filter of this width.

    Args:
        width_px: Standard deviation of the filter, pixels; 0: no filter.
        lag: Distance along a row or column, pixels.
    """
    if width_px <= 0:
        return float(lag == 0)
    reach = int(np.ceil(6 * width_px)) + lag  # Of the weights e^-18 is left.
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / width_px) ** 2)
    shifted = weights[: len(weights) - lag] @ weights[lag:]
    return float(shifted / (weights @ weights))


def filter_width(correlations: Sequence[float]) -> float:
    """Return the width of the filter that gives these correlations.

    The sum of the correlations is matched, because it decides how far averaging reduces noise.

    Args:
        correlations: At lags 1, 2, ...: means over rows and columns.

    Returns:
        Standard deviation, pixels, 0 to 5; 0 if nearest neighbours correlate by less than 0.01,
        or if that is unknown.
    """
    from scipy.optimize import brentq  # Slow to import.

    wanted = float(np.sum(correlations))

    def excess(width: float) -> float:
        lags = range(1, len(correlations) + 1)
        return sum(neighbour_correlation(width, lag) for lag in lags) - wanted

    if not (correlations[0] > _WHITE and _WHITE < wanted < np.inf):
        return 0.0
    if excess(WIDEST_PX) <= 0:
        return WIDEST_PX
    return float(brentq(excess, 0.0, WIDEST_PX))  # pyright: ignore[reportArgumentType]


def frame_correlation(differences: np.ndarray) -> tuple[float, float]:
    """Return the correlation of successive frames, not bounded, and its standard error by tiles.

    Args:
        differences: Half the squared differences of frames one and two apart, in tiles, (2, T).

    Returns:
        NaN where nothing is known. Frames that are equal, as where depth is rounded, show no
        filter: zeros.
    """
    near, far = differences
    tiles = np.count_nonzero(near)
    if tiles < 2:
        value = 0.0 if near.size and not tiles else np.nan
        return value, value
    ratio = far.sum() / near.sum()
    spread = (far - ratio * near) / near.sum()
    error = np.sqrt((spread**2).sum() * tiles / (tiles - 1))
    return float(ratio - 1.0), float(error)


def mean_correlation(correlation: float, count: int) -> float:
    """Return the mean correlation of all pairs among successive frames; 0 of less than two.

    Args:
        correlation: Of two successive frames; of k apart it is that to the power of k.
        count: Number of frames.
    """
    if count < 2:
        return 0.0
    lags = np.arange(1, count)
    return float(((count - lags) * correlation**lags).sum() / (count - lags).sum())


def tiles_of(used: np.ndarray) -> np.ndarray:
    """Return the number of the tile of each used pixel of an image, (N,), of `used` (H, W)."""
    row, column = np.nonzero(used)
    return row // _TILE * (used.shape[1] // _TILE + 1) + column // _TILE
