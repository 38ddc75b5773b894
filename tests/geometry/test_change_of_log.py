"""The derivative of the logarithm along a step, against central differences."""

import pytest
import torch
from torch import Generator

from tofcorr.geometry import se3


@pytest.mark.parametrize("size", [0.0, 1e-6, 0.3, 2.5])
def test_it_is_the_slope_of_the_logarithm(size: float, generator: Generator) -> None:
    twist = torch.randn(6, generator=generator, dtype=torch.float64)
    twist = size * twist / twist[3:].norm()
    transform = se3.exp(twist)
    step = 1e-6 * torch.eye(6, dtype=torch.float64)
    apart = [se3.log(transform @ se3.exp(one)) - se3.log(transform @ se3.exp(-one)) for one in step]
    found = se3.change_of_log(twist)
    assert torch.allclose(found, torch.stack(apart, dim=1) / 2e-6, atol=1e-6)
