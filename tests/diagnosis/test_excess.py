"""Squares beyond the noise, by hand."""

from types import SimpleNamespace
from typing import cast

import pytest
import torch

from tofcorr.diagnosis.rerun.checks import Excess
from tofcorr.diagnosis.sums.observations import Observations


def test_poses_count_by_their_weights_and_unknown_pixels_not_at_all() -> None:
    unit, frame = torch.tensor([0, 1, 1]), torch.tensor([0, 0, 1, 2, 2])
    observations = cast("Observations", SimpleNamespace(unit=unit, frame=frame, num_units=2))
    left = torch.tensor([0.003, torch.nan, 0.005, 0.005, 0.001]).double()
    share = torch.tensor([1.0, 1.0, 0.5, 0.5, 2.0]).double()
    excess = Excess.of(observations, left, share, 0.001)
    assert excess.squares.tolist() == pytest.approx([8e-6, 24e-6])
    assert excess.weight.tolist() == [1.0, 3.0]
    assert excess.gap() == pytest.approx((32e-6 / 4) ** 0.5)
    drawn = excess.gaps(torch.tensor([[2.0, 0.0], [0.0, 2.0]]).double())
    assert drawn.tolist() == pytest.approx([8e-6**0.5, 8e-6**0.5])
    assert Excess.of(observations, left, share, 0.1).gap() == 0.0
