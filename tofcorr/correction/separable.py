"""Images that are the sum of a number a row and a number a column."""

from typing import NamedTuple

from torch import Tensor

# Largest difference of an image from a sum of rows and columns that stands for it, metres. A
# hundredth of the 1e-6 m to which an export must agree with the model.
_SEPARABLE = 1e-8


class Separated(NamedTuple):
    """An image as rows plus columns, plus the rest.

    Attributes:
        rows: Shape (H, 1).
        columns: Shape (1, W).
        rest: Shape (H, W); None if it is negligible.
    """

    rows: Tensor
    columns: Tensor
    rest: Tensor | None


def separated(error: Tensor) -> Separated:
    """Split an image of errors (H, W), metres, float64."""
    rows = error.mean(dim=1, keepdim=True)
    columns = error.mean(dim=0, keepdim=True) - error.mean()
    rest = error - rows - columns
    return Separated(rows, columns, rest if bool(rest.abs().max() > _SEPARABLE) else None)
