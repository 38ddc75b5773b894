"""Squares beyond the noise, by hand."""

from types import SimpleNamespace
from typing import cast

import pytest
import torch

from tofcorr.diagnosis.rerun.checks import excess_gaps
from tofcorr.diagnosis.sums.observations import Observations


def test_poses_count_by_their_weights_and_unknown_pixels_not_at_all() -> None:
    pose = torch.tensor([0, 0, 1, 1, 1])
    known = SimpleNamespace(per_pose=lambda values: torch.bincount(pose, values))
    observations = cast("Observations", known)
    left = torch.tensor([0.003, torch.nan, 0.005, 0.005, 0.001]).double()
    share = torch.tensor([1.0, 1.0, 0.5, 0.5, 2.0]).double()
    drawn = torch.tensor([[2.0, 0.0], [0.0, 2.0]]).double()
    gaps = excess_gaps(observations, left, share, 0.001, drawn)
    assert gaps.tolist() == pytest.approx([(32e-6 / 4) ** 0.5, 8e-6**0.5, 8e-6**0.5])
    assert excess_gaps(observations, left, share, 0.1, drawn[:0]).tolist() == [0.0]
