"""The phase between signals, where some carry no light."""

import torch

from tofcorr.simulation.effects.base import by_parameters, phase_difference


def test_a_pixel_without_light_has_no_shift_and_no_slope() -> None:
    """A zero amplitude in one pixel once made every finding of a diagnosis not a number."""
    own = torch.tensor([0.0, 1.0, 2.0j], dtype=torch.complex128)
    added = torch.tensor([1.0j, 1.0j, 1.0], dtype=torch.complex128)

    def shift(share: torch.Tensor) -> torch.Tensor:
        return phase_difference(own + share * added, own)

    slope = by_parameters(shift, torch.zeros(1, dtype=torch.float64))[:, 0]
    assert shift(torch.zeros(1)).tolist() == [0.0, 0.0, 0.0]
    # By hand: the part of the added signal at right angles to the own one, over its size.
    assert slope.tolist() == [0.0, 1.0, -0.5]
