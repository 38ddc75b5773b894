"""The ranges of the variables that a model is calibrated on."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

from torch import Tensor

from tofcorr.conditions import CONDITIONS


class Interval(NamedTuple):
    """A closed interval of one variable."""

    low: float
    high: float

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

    height: int
    width: int
    radial_distance: Interval
    amplitude: Interval | None = None
    normalised_amplitude: Interval | None = None
    modulation_frequency: float | None = None
    conditions: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)

    def mean_conditions(self) -> list[float]:
        """Return the mean conditions in the order of `CONDITIONS`; 0 where unknown."""
        return [self.conditions.get(name, (0.0, 0.0, 0.0))[2] for name in CONDITIONS]
