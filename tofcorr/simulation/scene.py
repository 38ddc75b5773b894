"""The target: a flat wall, uniform or with a checkerboard, and its reflectivity in each pixel."""

from collections.abc import Mapping
from itertools import product
from typing import Annotated, Literal, Self

import torch
from pydantic import Field, model_validator
from torch import Tensor

from tofcorr.errors import ConfigError
from tofcorr.geometry.se3 import UNIT_LENGTH_TOLERANCE
from tofcorr.options import Count, Number, Options, PositiveNumber, Share, Vector3


class UniformTarget(Options):
    """A wall of one reflectivity."""

    pattern: Literal["uniform"] = "uniform"
    reflectivity: Share = 0.8


class CheckerboardTarget(Options):
    """A wall of alternating dark and bright squares.

    Attributes:
        squares: Columns and rows of a board in the middle of a bright wall; null: squares without
            an end.
    """

    pattern: Literal["checkerboard"] = "checkerboard"
    square_mm: PositiveNumber = 80.0
    squares: tuple[Count, Count] | None = None
    reflectivity_dark: Share = 0.1
    reflectivity_bright: Share = 0.8


Target = Annotated[UniformTarget | CheckerboardTarget, Field(discriminator="pattern")]


class PlaneOptions(Options):
    """Plane of the wall: n . x + d = 0 in the world, n towards the camera."""

    normal: Vector3 = (0.0, 0.0, 1.0)
    offset_m: Number = 0.0

    @model_validator(mode="after")
    def _unit_length(self) -> Self:
        length = sum(entry * entry for entry in self.normal) ** 0.5
        if abs(length - 1) > UNIT_LENGTH_TOLERANCE:
            raise ValueError(f"the normal must have length 1, its length is {length:.6g}")
        return self

    def tensors(self) -> tuple[Tensor, Tensor]:
        """Return the unit normal (3,) and the offset ()."""
        normal = torch.tensor(self.normal, dtype=torch.float64)
        return normal / normal.norm(), torch.tensor(self.offset_m, dtype=torch.float64)


class SceneOptions(Options):
    """The targets by name, and the plane they lie in.

    Attributes:
        targets: Appearance of each name in the column `target` of a recording.
        plane: Plane of the wall.
        subsamples: Points along each side of the footprint of a pixel that an edge crosses.
    """

    targets: dict[str, Target] = Field(
        default_factory=lambda: {"white": UniformTarget(), "checkerboard": CheckerboardTarget()}
    )
    plane: PlaneOptions = PlaneOptions()
    subsamples: Annotated[int, Field(ge=1, le=64)] = 5


def target_named(targets: Mapping[str, Target], name: str) -> Target:
    """Return the target of that name.

    Raises:
        ConfigError: The scene has no such target.
    """
    if name not in targets:
        known = ", ".join(targets)
        raise ConfigError(f"scene.targets: no target '{name}' (known: {known}); describe it there.")
    return targets[name]


def seen_reflectivity(target: Target, target_xy: Tensor, subsamples: int) -> Tensor:
    """Return the mean reflectivity inside the footprint of every pixel.

    The footprint of a pixel is the parallelogram that half the steps to its neighbours span.
    If it is within one square, the mean is the square's reflectivity; otherwise it is sampled.

    Args:
        target: Appearance of the wall.
        target_xy: Point of the wall in the centre of each pixel, in coordinates of the target,
            shape (H, W, 2), metres.
        subsamples: Points along each side of a footprint.

    Returns:
        Shape (H, W).
    """
    if isinstance(target, UniformTarget):
        return torch.full_like(target_xy[..., 0], target.reflectivity)
    in_squares = target_xy / (target.square_mm / 1000)
    board = None
    if target.squares is not None:
        board = in_squares.new_tensor(target.squares)
        in_squares = in_squares + board / 2
    share_bright = _bright(in_squares, board)
    # How the coordinates change from row to row, and from column to column.
    steps = [
        torch.gradient(in_squares, dim=axis)[0] if count > 1 else torch.zeros_like(in_squares)
        for axis, count in enumerate(in_squares.shape[:2])
    ]
    reach = (steps[0].abs() + steps[1].abs()) / 2
    crossed = (torch.floor(in_squares - reach) != torch.floor(in_squares + reach)).any(-1)
    # Coordinates first, so that each is contiguous in memory: twice as fast.
    at, down, right = (each[crossed].T.contiguous() for each in (in_squares, *steps))
    inside = (torch.arange(subsamples, dtype=at.dtype) + 0.5) / subsamples - 0.5
    places = (at + a * down + b * right for a, b in product(inside, inside))
    share_bright[crossed] = sum(_bright(place.T, board) for place in places) / subsamples**2
    contrast = target.reflectivity_bright - target.reflectivity_dark
    return target.reflectivity_dark + contrast * share_bright


def _bright(in_squares: Tensor, board: Tensor | None) -> Tensor:
    """Return 1.0 in bright squares and 0.0 in dark ones; coordinates (..., 2) in squares.

    Beyond a board of so many squares, (2,), all is bright.
    """
    square = torch.floor(in_squares)
    bright = torch.remainder(square.sum(-1), 2.0)
    if board is None:
        return bright
    return bright.masked_fill(((square < 0) | (square >= board)).any(-1), 1.0)
