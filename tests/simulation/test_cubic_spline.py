"""The cubic spline is SciPy's, for few knots and many, close and far apart."""

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from tofcorr.simulation.cubic_spline import cubic_coefficients, on_spline


@pytest.mark.parametrize("count", [2, 3, 4, 5, 9, 200])
@pytest.mark.parametrize("columns", [(), (3,)])
def test_it_is_scipys(count: int, columns: tuple[int, ...]) -> None:
    rng = np.random.default_rng(count)
    knots = np.cumsum(rng.uniform(0.05, 1.0, count))
    values = rng.normal(size=(count, *columns))
    theirs = CubicSpline(knots, values)
    ours = cubic_coefficients(knots, values)
    np.testing.assert_allclose(ours, theirs.c, rtol=1e-8, atol=1e-8 * np.abs(theirs.c).max())
    at = np.concatenate([knots, rng.uniform(knots[0], knots[-1], 50)])
    size = np.abs(theirs(at)).max()
    np.testing.assert_allclose(on_spline(knots, ours, at), theirs(at), atol=1e-9 * size)
