"""The evidence behind the findings, and what figures show of it."""

from dataclasses import dataclass

import numpy as np
import torch

from tofcorr.diagnosis.findings.absorption import AbsorptionTable, absorption_table
from tofcorr.diagnosis.findings.naming import NamedEffects
from tofcorr.diagnosis.sums.left_out import left_out_model
from tofcorr.diagnosis.sums.study import Study


@dataclass(frozen=True, kw_only=True)
class Evidence:
    """What the findings were computed from.

    Attributes:
        study: The recording, before any effect was named.
        named: The effects named, with all comparisons.
    """

    study: Study
    named: NamedEffects


@dataclass(frozen=True, kw_only=True)
class FigureData:
    """What the figures show beyond the findings.

    Attributes:
        absorption: What calibration and other effects absorb of each effect.
        pose_errors: Held-out error of each pose before and after the effects, (U,) each, metres.
    """

    absorption: AbsorptionTable
    pose_errors: tuple[np.ndarray, np.ndarray]


def figure_data(evidence: Evidence) -> FigureData:
    """Compute what the figures show beyond the findings."""
    study, named = evidence.study, evidence.named
    return FigureData(
        absorption=absorption_table(study),
        pose_errors=(
            _pose_errors(study, ()),
            _pose_errors(named.study, named.columns),
        ),
    )


def _pose_errors(study: Study, names: tuple[str, ...]) -> np.ndarray:
    """Return the held-out root mean square of each pose, shape (U,), metres."""
    model = left_out_model(study, names)
    mean: torch.Tensor = model.squares() / model.pose_count.clamp(min=1e-12)
    return mean.clamp(min=0.0).sqrt().numpy()
