"""The ranges that scale the variables of error terms."""

from pathlib import Path

import pytest
import torch
from cameras import camera
from diagnosed_recordings import recorded

from tofcorr.conditions import CONDITIONS
from tofcorr.diagnosis.sums.base import BaseModel
from tofcorr.diagnosis.sums.observations import observe
from tofcorr.error_terms.model import ErrorModelOptions
from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.lattice import covered_domain, domain_from

CAMERA = camera((4, 3), (3.0, 3.0), (1.5, 1.0))


def test_a_range_leaves_a_share_outside_and_a_condition_is_known_of_every_frame() -> None:
    distance = torch.linspace(1.0, 2.0, 1001, dtype=torch.float64)
    unknown = torch.full((5, len(CONDITIONS)), torch.nan)
    domain = domain_from(CAMERA, distance, None, 20e6, unknown)
    assert domain.radial_distance == pytest.approx((1.001, 1.999))
    assert (domain.amplitude, domain.normalised_amplitude) == (None, None)
    assert (domain.height, domain.width, domain.modulation_frequency) == (3, 4, 20e6)
    conditions = torch.full((3, len(CONDITIONS)), torch.nan, dtype=torch.float64)
    conditions[:, 0] = torch.tensor([0.0, 10.0, 50.0])
    conditions[:2, 1] = 1e-3
    domain = domain_from(CAMERA, torch.ones(9), torch.ones(9), None, conditions)
    assert domain.conditions == {CONDITIONS[0]: (0.0, 50.0, 20.0)}


def test_training_and_diagnosis_scale_by_the_same_variables(tmp_path: Path) -> None:
    recording = recorded(tmp_path / "recording", 47)
    training = covered_domain(Dataset((recording,)), range(recording.num_frames))
    observed = observe(recording, 1_000_000)
    diagnosis = BaseModel(observed, ErrorModelOptions(), hand_eye_free=False).domain
    assert diagnosis.modulation_frequency == training.modulation_frequency
    assert diagnosis.conditions == training.conditions
    assert diagnosis.radial_distance == pytest.approx(training.radial_distance, abs=1e-6)
