"""What a look-up table does not read, it refuses in words."""

import numpy as np
import pytest

from tofcorr.correction.lookup import LookupTable, interpolate


def test_a_frame_of_another_size_is_refused_with_both_sizes() -> None:
    arrays = {"offset": np.zeros((2, 3)), "table": np.zeros((4, 1))}
    table = LookupTable(**arrays, radial_of_z=np.ones((1, 1)), metadata={})
    frame = np.ones((3, 2))
    with pytest.raises(ValueError, match=r"expected the camera's \(2, 3\).* got \(3, 2\)"):
        table(frame, frame)


@pytest.mark.parametrize("columns", [1, 5])
def test_interpolation_is_exact_for_what_is_bilinear(columns: int) -> None:
    row, column = np.random.default_rng(0).uniform(size=(2, 50))
    across = np.linspace(0, 1, columns) if columns > 1 else np.zeros(1)
    nodes = np.linspace(0, 1, 7)[:, None]
    table = 0.3 + 2.0 * nodes - across * (1.0 - 3.0 * nodes)
    at = column if columns > 1 else np.zeros(())
    expected = 0.3 + 2.0 * row - at * (1.0 - 3.0 * row)
    np.testing.assert_allclose(interpolate(table, row, column), expected, atol=1e-14)
    assert np.isnan(interpolate(table, np.array([np.nan]), np.zeros(1)))
