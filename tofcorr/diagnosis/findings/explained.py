"""What parameters and effects explain of the gap as given, held to what the noise allows."""

from typing import NamedTuple

FLOOR_ERROR = 0.05
"""Relative uncertainty of the floor from repeats or neighbouring pixels. Chosen; a test compares
the noise estimate with the truth of a simulator to this accuracy."""


class Explained(NamedTuple):
    """What parameters and effects explain of the residual of a simulator as given, m^2.

    Attributes:
        explained: Its mean square.
        least, most: The mean square of the residual less that of the noise, which is known to
            `FLOOR_ERROR`: what is explained and what is left together lie between these.
    """

    explained: float
    least: float
    most: float

    def with_left(self, left: float) -> float:
        """Return the square of the gap as given, if this square is left, m^2."""
        return min(max(self.explained + max(left, 0.0), self.least), max(self.most, 0.0))
