"""The ranges of the variables that a model is calibrated on."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import inf, log
from typing import Annotated, Literal, NamedTuple

import numpy as np
from pydantic import AfterValidator, ConfigDict
from torch import Tensor

from tofcorr.conditions import CONDITIONS
from tofcorr.errors import CalibrationDataError
from tofcorr.options import FiniteNumber, PositiveNumber, Size

Variable = Literal["distance", "amplitude", "normalised_amplitude", "log_amplitude"]
"""What a signal term is a function of; the normalised amplitude is N = I D^2."""
LOG_FLOOR = 1e-4
"""Amplitudes below this share of the calibrated maximum (no unit) enter the logarithm as this
share: the logarithm of a dead pixel carries no information. Set by hand; four decades are more than
any camera resolves."""


class Interval(NamedTuple):
    """A closed interval of one variable."""

    low: FiniteNumber
    high: FiniteNumber

    @property
    def centre(self) -> float:
        """The midpoint."""
        return (self.low + self.high) / 2

    @property
    def half_width(self) -> float:
        """Half the length; 1 for an interval of no length, so that scaling by it stays defined."""
        return (self.high - self.low) / 2 or 1.0

    def scale(self, values: Tensor) -> Tensor:
        """Map the interval onto [-1, 1]."""
        return (values - self.centre) / self.half_width

    def outwards(self) -> "Interval":
        """Return the smallest interval between float32 numbers that holds this one."""
        low, high = np.float32(self.low), np.float32(self.high)
        if low > self.low:
            low = np.nextafter(low, np.float32(-inf))
        if high < self.high:
            high = np.nextafter(high, np.float32(inf))
        return Interval(float(low), float(high))


EVERYTHING = Interval(-inf, inf)
"""No limits."""


def _ordered(ends: Interval) -> Interval:
    if ends[0] > ends[1]:
        raise ValueError("the first end of a range is the lower one")
    return ends


def _known(given: Mapping[str, tuple[float, float, float]]) -> Mapping:
    for name in given:
        if name not in CONDITIONS:
            raise ValueError(f"'{name}' is no condition; known: {', '.join(CONDITIONS)}")
    return given


_Range = Annotated[Interval, AfterValidator(_ordered)]
_Three = tuple[FiniteNumber, FiniteNumber, FiniteNumber]


@dataclass(frozen=True, kw_only=True)
class Domain:
    """Where a model holds: image size, distances and amplitudes seen in calibration.

    Attributes:
        height: Rows of the image.
        width: Columns of the image.
        radial_distance: Range of measured distances along the ray, metres.
        amplitude: Range of amplitudes in the camera's units; None without amplitudes.
        normalised_amplitude: Range of N = I D^2; None without amplitudes.
        modulation_frequency: Of the light, Hz; None if unknown.
        conditions: Lowest, highest and mean value of each of `CONDITIONS` that is known of all
            frames.
    """

    __pydantic_config__ = ConfigDict(extra="forbid")  # For the files that hold one.

    height: Size
    width: Size
    radial_distance: _Range
    amplitude: _Range | None = None
    normalised_amplitude: _Range | None = None
    modulation_frequency: PositiveNumber | None = None
    conditions: Annotated[Mapping[str, _Three], AfterValidator(_known)] = field(
        default_factory=dict
    )

    def mean_conditions(self) -> list[float]:
        """Return the mean conditions in the order of `CONDITIONS`; 0 where unknown."""
        return [self.conditions.get(name, (0.0, 0.0, 0.0))[2] for name in CONDITIONS]

    def amplitude_floor(self) -> float:
        """Return the amplitude below which the logarithm is constant.

        Raises:
            CalibrationDataError: No amplitudes are known.
        """
        if self.amplitude is None or self.normalised_amplitude is None:
            raise CalibrationDataError(
                "The intensity term needs amplitude.npy, which the recording does not have: "
                "record amplitudes, or choose a model without an amplitude term."
            )
        return max(self.amplitude.high * LOG_FLOOR, 1e-30)

    def interval(self, variable: Variable) -> Interval:
        """Return the calibrated range of a variable.

        Raises:
            CalibrationDataError: It is an amplitude, and no amplitudes are known.
        """
        if variable == "distance":
            return self.radial_distance
        floor = self.amplitude_floor()
        assert self.amplitude is not None
        assert self.normalised_amplitude is not None
        if variable == "log_amplitude":
            return Interval(*(log(max(end, floor)) for end in self.amplitude))
        return self.amplitude if variable == "amplitude" else self.normalised_amplitude
