"""Polynomials without a constant, on a centred and scaled variable."""

from functools import lru_cache
from typing import Literal, NamedTuple

import torch
from numpy.polynomial import Polynomial
from torch import Tensor


class ScaledPolynomial(NamedTuple):
    """The polynomial sum_k c_k u^k, k = 1..K, in u = (x - centre) / half_width.

    Attributes:
        variable: What x is; the normalised amplitude is N = I D^2.
        coefficients: c_1 .. c_K, shape (K,), metres.
        centre: In units of x.
        half_width: In units of x.
    """

    variable: Literal["distance", "amplitude", "normalised_amplitude"]
    coefficients: Tensor
    centre: float
    half_width: float


def powers(scaled: Tensor, degree: int) -> Tensor:
    """Return u, u^2, ..., u^degree, shape (degree, ...)."""
    columns = [scaled]
    for _ in range(degree - 1):
        columns.append(columns[-1] * scaled)
    return torch.stack(columns)


def horner(coefficients: Tensor, scaled: Tensor) -> Tensor:
    """Return sum_k coefficients[k] u^(k+1), shape of `scaled`."""
    degree = coefficients.shape[0]
    value = scaled * coefficients[degree - 1]
    for k in range(degree - 2, -1, -1):
        value = (value + coefficients[k]) * scaled
    return value


def unscale(coefficients: Tensor, centre: float, half_width: float) -> list[float]:
    """Expand a polynomial in u = (x - centre) / half_width into powers of x.

    Args:
        coefficients: Coefficients of u, u^2, ..., shape (degree,).
        centre: Centre of the scaled variable, in units of x.
        half_width: Its half-width, in units of x.

    Returns:
        Coefficients of 1, x, x^2, ...: one more than were given.
    """
    outer = torch.cat([coefficients.new_zeros(1), coefficients])
    return _compose(outer, -centre / half_width, 1.0 / half_width)


def unit_of_power(variable: str, power: int) -> str:
    """Return the unit of the coefficient of x^power in an error in metres, such as `m/pixel^2`."""
    return f"m/{variable}" if power == 1 else f"m/{variable}^{power}"


def rescale(raw: list[float], centre: float, half_width: float) -> tuple[list[float], float]:
    """Turn coefficients of x, x^2, ... into those of u, u^2, ...: the inverse of `unscale`.

    Returns:
        The coefficients of u, u^2, ..., and the constant that remains.
    """
    scaled = _compose(torch.tensor([0.0, *raw], dtype=torch.float64), centre, half_width)
    return scaled[1:], scaled[0]


def _compose(outer: Tensor, constant: float, slope: float) -> list[float]:
    """Return the coefficients of outer(constant + slope x)."""
    powers_of_line = _powers_of_line(constant, slope, outer.numel())
    return (outer.detach().double().cpu() @ powers_of_line).tolist()


@lru_cache(maxsize=64)
def _powers_of_line(constant: float, slope: float, count: int) -> Tensor:
    """Return the coefficients of (constant + slope x)^k, k = 0, 1, ..., shape (count, count)."""
    line = Polynomial([constant, slope])
    rows = [(line**k).coef.tolist() for k in range(count)]
    return torch.tensor([row + [0.0] * (count - len(row)) for row in rows], dtype=torch.float64)
