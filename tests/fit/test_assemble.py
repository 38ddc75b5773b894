"""A hand-eye transform that is no rotation any more is refused in words."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tofcorr.errors import CalibrationDataError
from tofcorr.estimation.moments import Parameters
from tofcorr.fit.fitting import refuse_diverged

START = Parameters(torch.eye(4, dtype=torch.float64), torch.zeros(2, dtype=torch.float64))
UNIT = torch.tensor([0.1, -0.2, 0.3, 2.0, 3.0, 6.0, 0.0, 0.0], dtype=torch.float64) / 7


@given(steps=st.lists(st.floats(-100.0, 100.0), min_size=1, max_size=20))
def test_steps_of_any_sensible_size_leave_a_rotation(steps: list[float]) -> None:
    found = START
    for step in steps:
        found = found.moved(step * UNIT)
    refuse_diverged(found)
    rotation = found.tool_from_camera[:3, :3]
    identity = torch.eye(3, dtype=torch.float64)
    torch.testing.assert_close(rotation @ rotation.T, identity, rtol=0, atol=1e-9)


@pytest.mark.parametrize("step", [1e12, float("inf"), float("nan")])
def test_an_estimate_without_bounds_is_refused(step: float) -> None:
    # Five frames once ended in a ValueError about a matrix.
    with pytest.raises(CalibrationDataError, match="do not determine the hand-eye transform"):
        refuse_diverged(START.moved(step * UNIT))
