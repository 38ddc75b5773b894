"""Removes from data what unknown quantities would explain."""

import torch
from torch import Tensor


def project_out(nuisance: Tensor, *columns: Tensor) -> tuple[Tensor, ...]:
    """Return columns minus their least squares fit by the nuisance.

    Args:
        nuisance: What the unknown quantities add to the data, shape (M, K).
        columns: Vectors (M,) or matrices (M, L).
    """
    q = torch.linalg.qr(nuisance).Q
    return tuple(column - q @ (q.T @ column) for column in columns)
