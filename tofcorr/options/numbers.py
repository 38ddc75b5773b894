"""Numbers in files: finite, and of a size that some camera or robot could have."""

from typing import Annotated

from pydantic import BeforeValidator, Field, PositiveInt

LARGEST_NUMBER = 1e12
"""Largest number read from a file, in the file's own unit. Chosen: a hundred times the fastest
modulation of light, 10 GHz, which is the largest quantity here; its cube still fits a float32."""
SMALLEST_POSITIVE = 1e-12
"""Smallest positive number read where zero is not allowed, in the file's own unit. The reciprocal
of `LARGEST_NUMBER`: nothing that is divided by it overflows."""
LARGEST_DEGREE = 30
"""Highest power of a polynomial (no unit). Chosen: scaled powers above it differ by less than
noise, and a degree of a million fills the memory."""
LARGEST_SIDE = 1_000_000
"""Largest width or height of an image, pixels. Set by hand: more than any image sensor has."""


def not_a_truth_value(value: object) -> object:
    """Refuse true and false, which Python takes for 1 and 0."""
    if isinstance(value, bool):
        # pydantic reports a ValueError; a TypeError would pass through it.
        raise ValueError("expected a number, not true or false")  # noqa: TRY004
    return value


# Text is passed on to the number parser: YAML 1.1 reads 20.0e6 (no sign) as text.
FiniteNumber = Annotated[float, BeforeValidator(not_a_truth_value), Field(allow_inf_nan=False)]
Number = Annotated[FiniteNumber, Field(ge=-LARGEST_NUMBER, le=LARGEST_NUMBER)]
PositiveNumber = Annotated[FiniteNumber, Field(ge=SMALLEST_POSITIVE, le=LARGEST_NUMBER)]
Degree = Annotated[PositiveInt, Field(le=LARGEST_DEGREE)]
Size = Annotated[int, BeforeValidator(not_a_truth_value), Field(gt=0, le=LARGEST_SIDE)]
