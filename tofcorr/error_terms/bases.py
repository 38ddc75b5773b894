"""The functions that terms are made of: powers and B-splines of scaled variables.

Powers leave out the constant, which an error model has already. So do B-splines, which sum to one:
the function in the middle is omitted. They are uniform, of degree 1 and 3 on [-1, 1], and keep
their value at the edge beyond it. All of it compiles with TorchScript but what is of lists.
"""

from functools import lru_cache
from typing import NamedTuple

import torch
from numpy.polynomial import Polynomial
from torch import Tensor

from tofcorr.error_terms.domain import Variable


class ScaledPolynomial(NamedTuple):
    """The polynomial sum_k c_k u^k, k = 1..K, in u = (x - centre) / half_width.

    Attributes:
        variable: What x is.
        coefficients: c_1 .. c_K, shape (K,), metres.
        centre: In units of x.
        half_width: In units of x.
    """

    variable: Variable
    coefficients: Tensor
    centre: float
    half_width: float


class Axis(NamedTuple):
    """Equally spaced knots of one variable; between them a term is smooth.

    Attributes:
        variable: What x is.
        low: First knot, in units of x; below it the term keeps its value there.
        high: Last knot; beyond it the term keeps its value there.
        segments: Number of pieces.
    """

    variable: Variable
    low: float
    high: float
    segments: int = 1


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
    line = _powers_of_line(-centre / half_width, 1.0 / half_width, len(coefficients) + 1)
    return (coefficients.detach().double().cpu() @ line[1:]).tolist()


def rescale(raw: list[float], centre: float, half_width: float) -> tuple[list[float], float]:
    """Turn coefficients of x, x^2, ... into those of u, u^2, ...: the inverse of `unscale`.

    Returns:
        The coefficients of u, u^2, ..., and the constant that remains.
    """
    line = _powers_of_line(centre, half_width, len(raw) + 1)
    constant, *scaled = (torch.tensor(raw, dtype=torch.float64) @ line[1:]).tolist()
    return scaled, constant


@lru_cache(maxsize=64)
def _powers_of_line(constant: float, slope: float, count: int) -> Tensor:
    """Return the coefficients of (constant + slope x)^k, k = 0, 1, ..., shape (count, count)."""
    line = Polynomial([constant, slope])
    rows = [(line**k).coef.tolist() for k in range(count)]
    return torch.tensor([row + [0.0] * (count - len(row)) for row in rows], dtype=torch.float64)


def unit_of_power(variable: str, power: int) -> str:
    """Return the unit of the coefficient of x^power in an error in metres, such as `m/pixel^2`."""
    return f"m/{variable}" if power == 1 else f"m/{variable}^{power}"


def position(scaled: Tensor, segments: int) -> Tensor:
    """Map [-1, 1] onto the knots 0, 1, .., segments, clamped to the ends."""
    return (scaled.clamp(-1.0, 1.0) + 1.0) * (0.5 * segments)


def spline_basis(scaled: Tensor, segments: int, degree: int) -> Tensor:
    """Return all B-splines, shape (segments + degree, ...), of a variable scaled to [-1, 1]."""
    x = position(scaled, segments)
    functions = []
    for k in range(segments + degree):
        if degree == 1:
            functions.append((1.0 - (x - k).abs()).clamp(min=0.0))
        else:
            t = (x - (k - 1)).abs()
            outer, inner = (2.0 - t).clamp(min=0.0), (1.0 - t).clamp(min=0.0)
            functions.append((outer * outer * outer - 4.0 * inner * inner * inner) / 6)
    return torch.stack(functions)


def spline_weights(x: Tensor, segments: int, degree: int) -> tuple[Tensor, list[Tensor]]:
    """Return the first of the degree + 1 splines that are not zero, and their values.

    Args:
        x: As `position` gives it, shape (...); NaN gives values of NaN.
        segments: Number of segments.
        degree: 1 or 3.
    """
    first = x.nan_to_num(0.0).floor().clamp(0.0, float(segments - 1)).to(torch.int64)
    f = x - first
    g = 1.0 - f
    if degree == 1:
        return first, [g, f]
    square, other = f * f, g * g
    inner = 3.0 * (f - 2.0) * square + 4.0
    mirrored = 3.0 * (g - 2.0) * other + 4.0
    return first, [value / 6 for value in [g * other, inner, mirrored, f * square]]


def spline_value(full: Tensor, scaled: Tensor, segments: int, degree: int) -> Tensor:
    """Return sum_k full[k] B_k, shape of `scaled`, from the splines that are not zero."""
    first, weights = spline_weights(position(scaled, segments), segments, degree)
    value = weights[0] * full[first]
    for k in range(1, degree + 1):
        value = value + weights[k] * full[first + k]
    return value


def with_middle(coefficients: Tensor) -> Tensor:
    """Return the coefficients of all splines, with zero for the omitted one in the middle."""
    middle = (coefficients.shape[0] + 1) // 2
    zero = torch.zeros(1, dtype=coefficients.dtype, device=coefficients.device)
    return torch.cat([coefficients[:middle], zero, coefficients[middle:]])


def without_middle(values: Tensor) -> Tensor:
    """Omit the middle entry along the first dimension; inverse of `with_middle`."""
    middle = values.shape[0] // 2
    return torch.cat([values[:middle], values[middle + 1 :]])


def second_differences(size: int, segments: int) -> Tensor:
    """Return rows whose squared product with spline coefficients is the integrated curvature.

    The P-spline penalty of Eilers and Marx (1996): second differences of neighbouring
    coefficients, scaled so that the sum of their squares is about the integral of the squared
    second derivative over the interval mapped to [0, 1], for any number of segments.
    """
    rows = torch.diff(torch.eye(size, dtype=torch.float64), n=2, dim=0)
    return rows * segments**1.5
