"""The closed form of the exponential map and its derivative against the other form and autograd."""

import pytest
import torch

from tofcorr.geometry import se3
from tofcorr.geometry.se3_slope import exp_minus_identity_with_slope


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-3, 0.2, 0.3162, 0.3163, 1.5, 3.1, 6.0])
def test_value_and_derivative_are_those_of_the_map(
    angle: float, generator: torch.Generator
) -> None:
    translation, axis = torch.randn(2, 3, generator=generator, dtype=torch.float64)
    twist = torch.cat([translation, angle * axis / axis.norm()])
    value, slope = exp_minus_identity_with_slope(twist)
    torch.testing.assert_close(value, se3.exp_minus_identity(twist), rtol=1e-12, atol=1e-14)
    expected = torch.autograd.functional.jacobian(se3.exp_minus_identity, twist)
    assert isinstance(expected, torch.Tensor)
    torch.testing.assert_close(slope.permute(1, 2, 0), expected, rtol=1e-11, atol=1e-12)
