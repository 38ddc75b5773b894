"""Legendre polynomials on [-1, 1], in one and two variables."""

import torch
from torch import Tensor


def legendre(scaled: Tensor, degree: int) -> Tensor:
    """Return the Legendre polynomials P_1 ... P_degree of values (M,), shape (M, degree)."""
    previous, current = torch.ones_like(scaled), scaled
    columns = [current]
    for k in range(1, degree):
        previous, current = current, ((2 * k + 1) * scaled * current - k * previous) / (k + 1)
        columns.append(current)
    return torch.stack(columns[:degree]).movedim(0, -1)


def products(x: Tensor, y: Tensor, low: int, high: int) -> Tensor:
    """Return P_i(x) P_j(y) for low <= i + j <= high, ordered as `exponents`, shape (M, K)."""
    one = torch.ones_like(x)[:, None]
    of_x = torch.cat([one, legendre(x, high)], dim=1)
    of_y = torch.cat([one, legendre(y, high)], dim=1)
    return torch.stack([of_x[:, i] * of_y[:, j] for i, j in exponents(low, high)], dim=-1)


def weighted_products(x: Tensor, y: Tensor, low: int, high: int, weights: Tensor) -> Tensor:
    """Return `products(x, y, low, high) @ weights`, shape (M,), without the large matrix."""
    weight = dict(zip(exponents(low, high), weights, strict=True))
    one = torch.ones_like(x)
    of_x, of_y = ([one, *legendre(values, high).unbind(-1)] for values in (x, y))
    total = torch.zeros_like(x)
    for j, factor in enumerate(of_y):
        powers = [i for i in range(high + 1) if (i, j) in weight]
        inner = sum((weight[i, j] * of_x[i] for i in powers), torch.zeros_like(x))
        total = torch.addcmul(total, factor, inner)
    return total


def exponents(low: int, high: int) -> list[tuple[int, int]]:
    """Return all (i, j) with low <= i + j <= high."""
    return [(total - j, j) for total in range(low, high + 1) for j in range(total + 1)]
