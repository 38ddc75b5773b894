"""Which model predicts best, and which ones do as well: paired comparisons of held-out errors."""

import math
from dataclasses import dataclass

import numpy as np

from tofcorr.estimation.student import student_quantile

# Confidence level of the intervals and of the ties. The usual convention.
_LEVEL = 0.95


@dataclass(frozen=True)
class RankedModel:
    """One model compared with the best.

    Attributes:
        error: Mean held-out error over the poses, millimetres.
        standard_error: Of that mean.
        behind: Mean of this model's error minus the best one's, pose by pose, millimetres.
        behind_standard_error: Of that difference.
        interval: 95 % interval of the difference.
        complexity: Number of unknowns of the model.
    """

    error: float
    standard_error: float
    behind: float
    behind_standard_error: float
    interval: tuple[float, float]
    complexity: int


@dataclass(frozen=True)
class Ranking:
    """The models of one cross-validation.

    Attributes:
        models: Each model compared with the best, in the order given.
        best: The model of the smallest held-out error.
        winner: The simplest model within one standard error of the best.
        ties: Models whose 95 % interval of the difference to the winner contains zero.
    """

    models: dict[str, RankedModel]
    best: str
    winner: str
    ties: list[str]


def rank(errors: dict[str, np.ndarray], complexity: dict[str, int], num_groups: int) -> Ranking:
    """Compare models on poses that they were not fitted to.

    Poses held out together share a fit, and fits share most of their poses; so the variance of a
    mean over N poses is taken as s^2 / N (1 + K / (K - 1)) with K groups held out in turn, the
    correction of Nadeau and Bengio (2003) for one pose's share. The one-standard-error rule
    (Breiman et al. 1984) is applied to the paired difference, whose standard error is much smaller
    than that of either error: easy images are easy for all models.

    The order of the models does not matter: equal errors are ranked by complexity, then by name.

    Args:
        errors: Each model's held-out error of each pose, shape (N,), in the same order of poses.
        complexity: Number of unknowns of each model.
        num_groups: K.
    """
    best = min(errors, key=lambda name: (float(errors[name].mean()), complexity[name], name))
    models = {}
    for name, values in errors.items():
        behind, behind_error, half_width = _mean_with_interval(values - errors[best], num_groups)
        _, own_error, _ = _mean_with_interval(values, num_groups)
        models[name] = RankedModel(
            error=float(values.mean()),
            standard_error=own_error,
            behind=behind,
            behind_standard_error=behind_error,
            interval=(behind - half_width, behind + half_width),
            complexity=complexity[name],
        )
    near = [
        name
        for name, one in models.items()
        if name == best or one.behind <= one.behind_standard_error
    ]
    winner = min(near, key=lambda name: (complexity[name], models[name].error, name))
    ties = [
        name
        for name in errors
        if name != winner and _tied(errors[name], errors[winner], num_groups)
    ]
    return Ranking(models, best, winner, ties)


def _tied(first: np.ndarray, second: np.ndarray, num_groups: int) -> bool:
    difference, _, half_width = _mean_with_interval(first - second, num_groups)
    return abs(difference) <= half_width


def _mean_with_interval(values: np.ndarray, num_groups: int) -> tuple[float, float, float]:
    """Return mean, standard error and the interval's half-width of values, one a pose."""
    count = len(values)
    if count < 2:
        return float(values.mean()), math.inf, math.inf
    factor = (1 + num_groups / (num_groups - 1)) / count
    error = float(values.std(ddof=1)) * math.sqrt(factor)
    return float(values.mean()), error, student_quantile((1 + _LEVEL) / 2, count - 1) * error
