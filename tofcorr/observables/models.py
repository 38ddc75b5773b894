r"""What a pixel does at an amplitude: its noise and its missing distances, as laws with numbers.

The noise has the standard deviation

.. math:: \sigma^2 = f^2 + s^2 \frac{A_0}{A} + r^2 \left(\frac{A_0}{A}\right)^2

with floor f, shot noise s of the signal, and r of readout and background light; the same law as in
`tofcorr.estimation.noise`. Light falls with the square of the distance: without amplitude, A0/A is
(D/D0)^2, so that s belongs to a part of sigma linear in the distance, and r to a quadratic one.

White noise filtered with the weights :math:`w_k = e^{-k^2/2\sigma^2}` has the correlation
:math:`\rho_L = \sum_k w_k w_{k+L} / \sum_k w_k^2` between pixels L apart in a row or column.

A pixel has no distance with the probability

.. math:: P = b + (1 - b) / (1 + (A / A_{1/2})^{1/w})

b is the share that is missing however bright it is; darker than :math:`A_{1/2}` more than half is.
"""

from collections.abc import Sequence
from typing import Annotated, Self, TypeVar

import numpy as np
from pydantic import Field
from torch import Tensor

from tofcorr.options import Number, Options, PositiveNumber

NonNegative = Annotated[Number, Field(ge=0)]
Share = Annotated[Number, Field(ge=0, le=1)]
ArrayT = TypeVar("ArrayT", np.ndarray, Tensor)

LEAST_VARIANCE = 1e-14
"""Square metres, (0.1 um)^2: less counts as free of noise. Chosen: float32 depth of 1 m is rounded
to 0.06 um."""
WIDEST_PX = 5.0
"""Widest filter of the noise that is looked for, pixels. Chosen: beyond all filters of cameras."""
# Correlation of nearest neighbours below which noise counts as white. Chosen: it changes the
# variance of a mean of nine pixels by less than 5 %. A filter of 0.2 pixels has 2 e^-12.5.
_WHITE, _NARROWEST_PX = 0.01, 0.2


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

    floor_m: NonNegative
    shot_m: NonNegative = 0.0
    read_m: NonNegative = 0.0
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
        if self.reference_amplitude is None:
            brightness = (self.reference_distance_m / distance) ** 2
        elif amplitude is None:
            raise ValueError("This noise curve depends on the amplitude; none is given.")
        else:
            brightness = amplitude / self.reference_amplitude
        darkness = 1.0 / brightness.clip(min=self.least_brightness)
        floor, shot, read = self.deviations if deviations is None else deviations
        return (floor**2 + darkness * (shot**2 + read**2 * darkness)) ** 0.5

    def temporal_sigma(self, distance: ArrayT, amplitude: ArrayT | None = None) -> ArrayT:
        """Return the standard deviation of what changes from frame to frame, as `sigma` does."""
        return self.sigma(distance, amplitude) * (1.0 - self.fixed_share) ** 0.5

    def with_fixed_share(self, share: float) -> Self:
        """Return the same temporal noise beside another fixed share of the whole variance."""
        factor = ((1.0 - self.fixed_share) / (1.0 - share)) ** 0.5
        names = ("floor_m", "shot_m", "read_m")
        changes = {name: getattr(self, name) * factor for name in names}
        return self.model_copy(update={**changes, "fixed_share": share})


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

    white = not (correlations[0] > _WHITE and wanted > _WHITE)
    if white or not np.isfinite(wanted) or excess(_NARROWEST_PX) >= 0:
        return 0.0
    if excess(WIDEST_PX) <= 0:
        return WIDEST_PX
    return float(brentq(excess, _NARROWEST_PX, WIDEST_PX))  # pyright: ignore[reportArgumentType]


class DropoutModel(Options):
    """The probability that a pixel gives no distance.

    Attributes:
        base_share: b, missing at any amplitude.
        amplitude_at_half: A_1/2, counts; null: the amplitude plays no part, or is not recorded.
        width: w, of the transition in ln A: from 73 % to 27 % missing within two widths.
        saturation_amplitude: The largest amplitude that the camera states, counts; a pixel that
            reaches it is not valid. Null: unknown.
        saturated_share: Share of those pixels that have no distance; null: as darker ones.
    """

    base_share: Share = 0.0
    amplitude_at_half: PositiveNumber | None = None
    width: PositiveNumber = 0.1
    saturation_amplitude: PositiveNumber | None = None
    saturated_share: Share | None = None

    @property
    def needs_amplitude(self) -> bool:
        """Whether anything depends on the amplitude."""
        return not (self.amplitude_at_half is self.saturation_amplitude is None)

    def probability(self, amplitude: ArrayT) -> ArrayT:
        """Return the probability that pixels of these amplitudes are missing; same shape.

        Saturated pixels count as others here, unless `saturated_share` is known.
        """
        share = amplitude * 0.0 + self.base_share
        if self.amplitude_at_half is not None:
            # No power of the share of the threshold overflows: e^-80 is nothing, e^80 a float32.
            brightest = np.exp(80 * self.width)
            relative = (amplitude / self.amplitude_at_half).clip(min=1e-6, max=brightest)
            share = share + (1.0 - self.base_share) / (1.0 + relative ** (1.0 / self.width))
        if self.saturated_share is not None:
            saturated = self.saturated(amplitude)
            share = share * ~saturated + self.saturated_share * saturated
        return share

    def saturated(self, amplitude: ArrayT) -> ArrayT:
        """Return where pixels are saturated, bool, same shape."""
        level = self.saturation_amplitude
        return amplitude >= (np.inf if level is None else level)
