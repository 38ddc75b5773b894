"""An offset for each pixel, independent of its neighbours."""

from typing import ClassVar, Literal

from pydantic import PositiveFloat

from tofcorr.error_terms.base import BaseTermOptions, PixelMap


class FixedPatternOptions(BaseTermOptions):
    """Options of `FixedPattern`.

    Attributes:
        spread_mm: Standard deviation of the pixels' offsets; `auto` estimates it.
    """

    kind: Literal["fixed_pattern"] = "fixed_pattern"
    spread_mm: Literal["auto"] | PositiveFloat = "auto"
    found_in_data: ClassVar[tuple[str, ...]] = ("spread_mm",)
    has_columns: ClassVar[bool] = False


class FixedPattern(PixelMap):
    """One offset a pixel: the fixed-pattern matrix of Kahlmann, Remondino and Ingensand (2006).

    It has no coefficients: each pixel's offset is estimated from its residuals to the fitted terms,
    and shrunk towards zero.

    Args:
        options: How much the offsets are shrunk.
        domain: The image size.
    """
