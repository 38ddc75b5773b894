"""Uniform B-splines of degree 1 and 3 on the interval [-1, 1], and their roughness.

The functions B_0 .. B_(K-1) sum to one. Beyond the interval a spline keeps its value at the edge.
An error model has a constant already, so a term omits the function in the middle.
"""

import torch
from torch import Tensor


def spline_size(segments: int, degree: int) -> int:
    """Return the number K of B-splines over so many equal segments."""
    return segments + degree


def position(scaled: Tensor, segments: int) -> Tensor:
    """Map [-1, 1] onto the knots 0, 1, .., segments, clamped to the ends."""
    return (scaled.clamp(-1.0, 1.0) + 1.0) * (0.5 * segments)


def spline_basis(scaled: Tensor, segments: int, degree: int) -> Tensor:
    """Return all B-splines, shape (K, ...), of a variable (...) scaled to [-1, 1]."""
    x = position(scaled, segments)
    functions = []
    for k in range(segments + degree):
        if degree == 1:
            functions.append((1.0 - (x - k).abs()).clamp(min=0.0))
        else:
            t = (x - (k - 1)).abs()
            outer, inner = (2.0 - t).clamp(min=0.0), (1.0 - t).clamp(min=0.0)
            functions.append((outer * outer * outer - 4.0 * inner * inner * inner) / 6.0)
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
    inner = (3.0 * f - 6.0) * square + 4.0
    mirrored = (3.0 * g - 6.0) * other + 4.0
    return first, [g * other / 6.0, inner / 6.0, mirrored / 6.0, f * square / 6.0]


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
