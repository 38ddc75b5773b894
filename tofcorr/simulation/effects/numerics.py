"""Derivatives by few parameters, small motions, and Legendre polynomials."""

from collections.abc import Callable

import torch
from torch import Tensor

from tofcorr.geometry import se3


def by_parameters(function: Callable[[Tensor], Tensor], at: Tensor) -> Tensor:
    """Return the derivatives of a function's values (M,) by its parameters (K,), shape (M, K).

    The gradient of u . f is linear in u, so that its own derivative by u is what is asked for. Each
    of the K columns then takes one pass backwards, and the function is evaluated once. (torch's
    forward mode evaluates it K times, and imports torch.compile, which takes as long as torch.)

    Args:
        function: Takes parameters (K,) and returns values (M,); differentiable twice by torch.
        at: Where to differentiate, shape (K,).
    """
    with torch.enable_grad():
        parameters = at.detach().clone().requires_grad_()
        values = function(parameters)
        if not values.requires_grad:
            return values.new_zeros(*values.shape, len(at))
        u = torch.zeros_like(values, requires_grad=True)
        # Sums and single numbers: given weights, torch would import SymPy to compare their shape.
        (gradient,) = torch.autograd.grad((values * u).sum(), parameters, create_graph=True)
        columns = [
            torch.autograd.grad(one, u, retain_graph=True, materialize_grads=True)[0]
            for one in gradient.unbind()
        ]
    return torch.stack(columns, dim=-1)


def phase_difference(signal: Tensor, own: Tensor) -> Tensor:
    """Return the phase of complex signals (M,) less that of others, radians; 0 without light.

    A signal of zero has no phase, and its derivative would be no number.
    """
    product = signal * own.conj()
    # Apart and in one piece each: `angle` of complex numbers takes three times as long.
    return torch.atan2(product.imag.contiguous(), product.real + (product == 0))


def by_frame(values: Tensor, matrices: Tensor, frame: Tensor) -> Tensor:
    """Multiply the values of each pixel by the matrix of its frame, shape (M, K).

    Args:
        values: Of the pixels, shape (M, J).
        matrices: Of the frames, shape (F, J, K).
        frame: Which frame a pixel belongs to, shape (M,), int64, in any order.
    """
    order = None if bool((frame.diff() >= 0).all()) else frame.argsort(stable=True)
    counts = torch.bincount(frame, minlength=len(matrices)).tolist()
    parts = (values if order is None else values[order]).split(counts)
    product = torch.cat([part @ own for part, own in zip(parts, matrices, strict=True)])
    return product if order is None else torch.empty_like(product).index_copy(0, order, product)


def small_motion(twist: Tensor) -> Tensor:
    """Return exp of twists (F, 6) to second order, shape (F, 4, 4).

    Exact to 1e-6 m at 10 cm, and to 1e-7 at 10 mrad.
    """
    matrix = (twist[:, :, None, None] * se3.GENERATORS.to(twist)).sum(1)
    return torch.eye(4).to(twist) + matrix + matrix @ matrix / 2


def inner_range(values: Tensor, beyond: float) -> tuple[float, float]:
    """Return the ends of what values (M,) lie between, but for a share of them at either end."""
    ordered, last = values.sort().values, len(values) - 1
    return float(ordered[int(beyond * last)]), float(ordered[int((1 - beyond) * last)])


# Legendre polynomials on [-1, 1], in one and two variables.


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


def side_by_side(columns: list[Tensor]) -> Tensor:
    """Return columns (M,) as a matrix (M, K), each of them in one piece of memory."""
    return torch.stack(columns).movedim(0, -1)


def exponents(low: int, high: int) -> list[tuple[int, int]]:
    """Return all (i, j) with low <= i + j <= high."""
    return [(total - j, j) for total in range(low, high + 1) for j in range(total + 1)]
