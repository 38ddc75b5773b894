"""Resamples of the poses of a study, and its model before anything is named."""

import torch

from tofcorr.diagnosis.findings.gap import resampled
from tofcorr.diagnosis.findings.naming import NamedEffects
from tofcorr.diagnosis.findings.probability import Models
from tofcorr.diagnosis.sums.study import Study


def resamples_of(study: Study, seed: int = 1) -> torch.Tensor:
    """Draw how often each resample of a study holds each pose."""
    generator = torch.Generator().manual_seed(seed)
    return resampled(study.sums.num_units, study.options.bootstraps, generator)


def unnamed(study: Study) -> NamedEffects:
    """Return the model of a study in which nothing is missing."""
    nothing = torch.zeros(1, study.sums.num_units, dtype=torch.float64)
    models = Models(models=((),), densities=nothing, sizes=({},), price=7.0)
    sure = torch.ones(1, dtype=torch.float64)
    return NamedEffects(study=study, names=(), sets={}, models=models, probability=sure)
