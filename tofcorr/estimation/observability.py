"""What the images cannot tell: directions left free, and parameters told apart only barely."""

from typing import NamedTuple

import torch
from torch import Tensor

from tofcorr.estimation.moments import ImageMoments
from tofcorr.estimation.objective import MomentObjective
from tofcorr.estimation.parameters import HAND_EYE_SYMBOLS, Parameters

# Relative curvature (each parameter scaled to its own) under which a direction counts as free.
_FREE = 1e-10
# Components of a free direction that are worth naming, relative to the largest.
_NAMED = 0.2


class Confounding(NamedTuple):
    """Two parameters that the images hardly tell apart."""

    first: str
    second: str
    correlation: float


class Observability(NamedTuple):
    """What the images leave open.

    Attributes:
        free: Names of the parameters that take part in each free direction.
        confounded: Pairs of strong correlation, strongest first.
        condition: Condition number of the scaled normal equations.
    """

    free: list[list[str]]
    confounded: list[Confounding]
    condition: float


def parameter_symbols(moments: ImageMoments, parameters: Parameters) -> list[str]:
    """Return the names of the unknowns in the order of a step."""
    hand_eye = HAND_EYE_SYMBOLS if parameters.hand_eye_is_free else []
    return [*hand_eye, *moments.symbols]


def observability(
    moments: ImageMoments, optimum: Parameters, threshold: float = 0.95
) -> Observability:
    """Look for free directions and strong correlations in the curvature of the loss.

    Args:
        moments: Moments of the images fitted.
        optimum: The parameters at the optimum.
        threshold: Absolute correlation from which a pair is named.
    """
    names = parameter_symbols(moments, optimum)
    hessian = MomentObjective(moments).normal_equations(optimum).hessian
    scale = hessian.diagonal().clamp(min=1e-300).sqrt()
    scaled = hessian / scale[:, None] / scale[None, :]
    values, vectors = torch.linalg.eigh(scaled)
    is_free = values < _FREE * values.max()
    free = [_participants(vectors[:, k], names) for k in is_free.nonzero()[:, 0].tolist()]
    kept = vectors[:, ~is_free]
    covariance = kept / values[~is_free] @ kept.T
    condition = float(values.max() / values.min().clamp(min=1e-300))
    return Observability(free, _strong_pairs(covariance, names, threshold), condition)


def _participants(direction: Tensor, names: list[str]) -> list[str]:
    size = direction.abs()
    return [names[k] for k in (size > _NAMED * size.max()).nonzero()[:, 0].tolist()]


def _strong_pairs(covariance: Tensor, names: list[str], threshold: float) -> list[Confounding]:
    spread = covariance.diagonal().clamp(min=1e-300).sqrt()
    correlation = covariance / spread[:, None] / spread[None, :]
    left, right = torch.triu_indices(len(names), len(names), offset=1).unbind(0)
    pairs = [
        Confounding(names[a], names[b], float(correlation[a, b]))
        for a, b in zip(left.tolist(), right.tolist(), strict=True)
        if abs(correlation[a, b]) >= threshold
    ]
    return sorted(pairs, key=lambda pair: -abs(pair.correlation))
