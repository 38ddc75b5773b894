"""The evidence behind the findings, and what figures show of it."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from tofcorr.diagnosis.findings.absorption import AbsorptionTable, absorption_table
from tofcorr.diagnosis.findings.naming import NamedEffects
from tofcorr.diagnosis.sums.study import Study, left_out_model


@dataclass(frozen=True, kw_only=True)
class Evidence:
    """What the findings were computed from.

    Attributes:
        study: The recording, before any effect was named.
        named: The effects named, with all comparisons.
        patterns: Values of maps in all pixels, shape (cells,), metres, by name, where the study has
            only some of them.
    """

    study: Study
    named: NamedEffects
    patterns: Mapping[str, Tensor] = field(default_factory=dict)

    @cached_property
    def absorption(self) -> AbsorptionTable:
        """What calibration and other effects absorb of each effect."""
        return absorption_table(self.study)

    @cached_property
    def pose_errors(self) -> tuple[np.ndarray, np.ndarray]:
        """Held-out error of each pose before and after the effects, (U,) each, metres."""
        before = _pose_errors(self.study, ())
        return before, _pose_errors(self.named.study, self.named.columns)


def _pose_errors(study: Study, names: tuple[str, ...]) -> np.ndarray:
    """Return the held-out root mean square of each pose, shape (U,), metres."""
    model = left_out_model(study, names)
    mean: torch.Tensor = model.squares() / model.pose_count.clamp(min=1e-12)
    return mean.clamp(min=0.0).sqrt().numpy()
