"""The error that belongs to each pixel, without any order."""

from typing import ClassVar, Literal

import torch
from pydantic import PositiveFloat
from torch import Tensor, nn

from tofcorr.error_terms.domain import Domain
from tofcorr.options import Options


class FixedPatternOptions(Options):
    """Options of `FixedPattern`.

    Attributes:
        spread_mm: Standard deviation of the pixels' offsets; `auto` estimates it.
    """

    kind: Literal["fixed_pattern"] = "fixed_pattern"
    spread_mm: Literal["auto"] | PositiveFloat = "auto"
    needs: ClassVar[tuple[str, ...]] = ()


class FixedPattern(nn.Module):
    """One offset a pixel: the fixed-pattern matrix of Kahlmann, Remondino and Ingensand (2006).

    It has no coefficients: the offsets are estimated pixel by pixel from what the terms leave,
    shrunk towards zero, and kept in a map.

    Args:
        options: How the offsets are shrunk.
        domain: The image size.

    Attributes:
        offset: Shape (H, W), metres, float64.
    """

    offset: Tensor

    def __init__(self, options: FixedPatternOptions, domain: Domain) -> None:
        super().__init__()
        size = (domain.height, domain.width)
        self.register_buffer("offset", torch.zeros(size, dtype=torch.float64))
