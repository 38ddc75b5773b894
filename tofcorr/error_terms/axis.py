"""The variable over which a term is made of pieces."""

from typing import Literal, NamedTuple


class Axis(NamedTuple):
    """Equally spaced knots of one variable; between them a term is smooth.

    Attributes:
        variable: What x is: the radial distance, the amplitude, or its natural logarithm.
        low: First knot, in units of x; below it the term keeps its value there.
        high: Last knot; beyond it the term keeps its value there.
        segments: Number of pieces.
    """

    variable: Literal["distance", "amplitude", "log_amplitude"]
    low: float
    high: float
    segments: int = 1

    @classmethod
    def around(
        cls,
        variable: Literal["distance", "amplitude", "log_amplitude"],
        centre: float,
        half_width: float,
        segments: int = 1,
    ) -> "Axis":
        """Return the axis of a variable that is scaled to [-1, 1]."""
        return cls(variable, centre - half_width, centre + half_width, segments)
