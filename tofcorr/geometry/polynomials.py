"""Legendre polynomials on [-1, 1], in one and two variables."""

import torch
from torch import Tensor


def legendre(scaled: Tensor, degree: int) -> list[Tensor]:
    """Return the Legendre polynomials P_0 ... P_degree of values (M,), each (M,)."""
    found = [torch.ones_like(scaled), scaled]
    for k in range(1, degree):
        found.append(((2 * k + 1) * scaled * found[-1] - k * found[-2]) / (k + 1))
    return found[: degree + 1]


def products(x: Tensor, y: Tensor, low: int, high: int) -> list[Tensor]:
    """Return P_i(x) P_j(y) for low <= i + j <= high, ordered as `exponents`, each (M,)."""
    of_x, of_y = legendre(x, high), legendre(y, high)
    return [of_x[i] * of_y[j] for i, j in exponents(low, high)]


def exponents(low: int, high: int) -> list[tuple[int, int]]:
    """Return all (i, j) with low <= i + j <= high."""
    return [(total - j, j) for total in range(low, high + 1) for j in range(total + 1)]
