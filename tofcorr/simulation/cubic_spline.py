"""The cubic spline through a table, without SciPy, which is slow to import."""

import numpy as np


def cubic_coefficients(knots: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the coefficients of the cubic spline through knots.

    The third derivative is continuous at the second knot and at the last but one ("not a knot", de
    Boor 1978, chapter IV), so that four knots or more reproduce any cubic polynomial. Three knots
    give a parabola, two a straight line.

    Args:
        knots: Increasing, at least two, shape (N,).
        values: At the knots, shape (N, ...).

    Returns:
        Of each piece, of powers 3, 2, 1, 0 of the distance from its first knot, (4, N - 1, ...).
    """
    ends = (1,) * (values.ndim - 1)
    width = np.diff(knots).reshape(-1, *ends)
    secant = np.diff(values, axis=0) / width
    slope = _slopes(width, secant)
    bend = (slope[:-1] + slope[1:] - 2 * secant) / width
    return np.stack([bend / width, (secant - slope[:-1]) / width - bend, slope[:-1], values[:-1]])


def on_spline(knots: np.ndarray, coefficients: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Return a spline's values.

    Args:
        knots: Shape (N,).
        coefficients: Of `cubic_coefficients`, shape (4, N - 1, ...).
        at: Positions, shape (M,); outside the knots the last piece goes on.

    Returns:
        Shape (M, ...).
    """
    piece = np.clip(np.searchsorted(knots, at, side="right") - 1, 0, len(knots) - 2)
    step = (at - knots[piece]).reshape(-1, *(1,) * (coefficients.ndim - 2))
    value = np.zeros(())
    for coefficient in coefficients:
        value = value * step + coefficient[piece]
    return value


def _slopes(width: np.ndarray, secant: np.ndarray) -> np.ndarray:
    """Return the first derivative at every knot, shape (N, ...)."""
    if len(width) == 1:
        return np.concatenate([secant, secant])
    if len(width) == 2:  # The parabola through three points.
        middle = (width[1] * secant[0] + width[0] * secant[1]) / (width[0] + width[1])
        return np.stack([2 * secant[0] - middle, middle, 2 * secant[1] - middle])
    # Second derivatives are equal from both sides at inner knots, third ones at the outermost two
    # of these: one equation a knot, of itself and its neighbours.
    first, last = width[0] + width[1], width[-1] + width[-2]
    below = np.concatenate([0 * width[:1], width[1:], last[None]])
    middle = np.concatenate([width[1:2], 2 * (width[:-1] + width[1:]), width[-2:-1]])
    above = np.concatenate([first[None], width[:-1], 0 * width[:1]])
    right = np.concatenate(
        [
            _end(width[0], width[1], secant[0], secant[1])[None],
            3 * (width[1:] * secant[:-1] + width[:-1] * secant[1:]),
            _end(width[-1], width[-2], secant[-1], secant[-2])[None],
        ]
    )
    return _three_diagonals(below, middle, above, right)


def _end(
    outer: np.ndarray, inner: np.ndarray, outer_secant: np.ndarray, inner_secant: np.ndarray
) -> np.ndarray:
    """Return the right side of the equation of an end."""
    both = outer + inner
    return ((outer + 2 * both) * inner * outer_secant + outer**2 * inner_secant) / both


def _three_diagonals(
    below: np.ndarray, middle: np.ndarray, above: np.ndarray, right: np.ndarray
) -> np.ndarray:
    """Solve equations of each unknown and its neighbours (Thomas 1949); (N, ...).

    Without exchange of rows: every pivot of a spline's equations is positive.
    """
    share, solved = np.empty_like(middle), np.empty_like(right)
    share[0], solved[0] = above[0] / middle[0], right[0] / middle[0]
    for k in range(1, len(right)):
        pivot = middle[k] - below[k] * share[k - 1]
        share[k] = above[k] / pivot
        solved[k] = (right[k] - below[k] * solved[k - 1]) / pivot
    for k in reversed(range(len(right) - 1)):
        solved[k] -= share[k] * solved[k + 1]
    return solved
