"""The ranges inside which a corrected pixel is valid."""

import math
from dataclasses import dataclass

import numpy as np

from tofcorr.correction.state import CalibrationState
from tofcorr.error_terms.domain import Domain, Interval
from tofcorr.error_terms.model import ErrorModel

EVERYTHING = Interval(-math.inf, math.inf)


@dataclass(frozen=True, kw_only=True)
class Limits:
    """The ranges inside which a pixel is valid, rounded outwards to float32.

    Every variable of the error is clamped to its range: beyond it the error at the range's edge is
    used. A variable that the error does not depend on has no limits.

    Attributes:
        radial_distance: Metres.
        amplitude: The camera's units.
        normalised_amplitude: Amplitude times squared distance.
        saturation_amplitude: A pixel at or above it is not valid; infinite if unknown.
    """

    radial_distance: Interval
    amplitude: Interval = EVERYTHING
    normalised_amplitude: Interval = EVERYTHING
    saturation_amplitude: float = math.inf

    @classmethod
    def of(cls, state: CalibrationState, error: ErrorModel) -> "Limits":
        """Return the limits of a calibration."""
        return cls.of_domain(state.domain, state.saturation_amplitude, error)

    @classmethod
    def of_domain(cls, domain: Domain, saturation: float | None, error: ErrorModel) -> "Limits":
        """Return the limits of an error model on calibrated ranges.

        Args:
            domain: The calibrated ranges.
            saturation: Amplitude from which on pixels are saturated; None if unknown.
            error: The model, whose terms say which variables it depends on.
        """
        amplitude = domain.amplitude if error.needs_amplitude() else None
        normalised = domain.normalised_amplitude if error.needs_normalised_amplitude() else None
        return cls(
            radial_distance=_outwards(domain.radial_distance),
            amplitude=EVERYTHING if amplitude is None else _outwards(amplitude),
            normalised_amplitude=EVERYTHING if normalised is None else _outwards(normalised),
            saturation_amplitude=math.inf if saturation is None else float(np.float32(saturation)),
        )


def _outwards(interval: Interval) -> Interval:
    """Return the smallest interval between float32 numbers that holds `interval`."""
    low, high = np.float32(interval.low), np.float32(interval.high)
    if low > interval.low:
        low = np.nextafter(low, np.float32(-np.inf))
    if high < interval.high:
        high = np.nextafter(high, np.float32(np.inf))
    return Interval(float(low), float(high))
