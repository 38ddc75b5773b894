"""Solutions of normal equations."""

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor


def solve_positive(matrix: Tensor, right: Tensor) -> Tensor:
    """Solve symmetric positive definite systems (..., K, K) for right sides (..., K, R).

    Raises:
        torch.linalg.LinAlgError: A matrix is singular.
    """
    return solver(matrix)(right)


def solver(matrix: Tensor) -> Callable[[Tensor], Tensor]:
    """Return what solves systems of `solve_positive` for any right sides (..., K, R).

    Cholesky's factors take half the time of Gauss's. Where rounding leaves a matrix that is not
    positive, as in recordings without noise, the general solution is used.
    """
    factor, failed = torch.linalg.cholesky_ex(matrix)
    if bool(failed.any()):
        return partial(torch.linalg.solve, matrix)
    return lambda right: torch.cholesky_solve(right, factor)


def inverse_squares(matrix: Tensor, right: Tensor) -> Tensor:
    """Return r' A^-1 r of positive definite A (..., K, K) for each column r of (..., K, R).

    Half the work of a solution. Returns shape (..., R); errors as in `solve_positive`.
    """
    factor, failed = torch.linalg.cholesky_ex(matrix)
    if bool(failed.any()):
        return (right * torch.linalg.solve(matrix, right)).sum(-2)
    return torch.linalg.solve_triangular(factor, right, upper=False).square().sum(-2)
