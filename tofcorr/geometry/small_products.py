"""Products of small matrices in the full precision of their numbers.

torch computes a matrix product of float32 in fewer digits where a program asks for speed: by
`torch.autocast`, or by `torch.set_float32_matmul_precision("high")` on a GPU. For a network that is
well; a point a metre away moves by a millimetre, or by a centimetre. Sums of products are left as
they are.
"""

from torch import Tensor


def product(left: Tensor, right: Tensor) -> Tensor:
    """Return the matrix product of small matrices, (..., N, K) and (..., K, M)."""
    return (left.unsqueeze(-1) * right.unsqueeze(-3)).sum(-2)


def transformed(transform: Tensor, points: Tensor) -> Tensor:
    """Return points in another frame.

    Args:
        transform: Rigid, shape (4, 4), metres.
        points: Shape (..., 3), metres.

    Returns:
        The points, shape (..., 3), metres.
    """
    moved = transform[:3, 3]
    for axis in range(3):
        moved = moved + points[..., axis : axis + 1] * transform[:3, axis]
    return moved


def projected(vectors: Tensor, directions: Tensor) -> Tensor:
    """Return the scalar products of vectors (..., 3) with directions (B, 3), shape (B, ...)."""
    shape = [len(directions)] + [1] * (vectors.dim() - 1)
    total = vectors[..., 0] * directions[:, 0].reshape(shape)
    for axis in range(1, 3):
        total = total + vectors[..., axis] * directions[:, axis].reshape(shape)
    return total
