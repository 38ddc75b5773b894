r"""What the images cannot tell: directions left free, and parameters told apart only barely.

Metres and radians are commensurate here: one milliradian moves a point at one metre by one
millimetre. A direction is a unit vector over all unknowns, and its sigma says how far the result
may be off along it. A wide Gaussian belief about every unknown keeps everything defined; where the
images say less than that belief, they leave the direction free.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from tofcorr.estimation.moments import ImageMoments
from tofcorr.estimation.objective import MomentObjective
from tofcorr.estimation.parameters import HAND_EYE_SYMBOLS, Parameters

BELIEF = 0.1
"""Standard deviation of the wide belief about every unknown: 100 mm, 100 mrad (5.7 degrees)."""

# Curvature relative to the largest (each parameter scaled to its own) that is only rounding.
_SINGULAR = 1e-10
# Components of a direction that are worth naming, relative to the largest.
_NAMED = 0.2
# Residuals are never believed to be better known than this (metres): data without any noise would
# otherwise make rounding look like information.
_LEAST_RESIDUAL = 1e-5


class Confounding(NamedTuple):
    """Two parameters that the images hardly tell apart."""

    first: str
    second: str
    correlation: float


class Direction(NamedTuple):
    """A combination of unknowns, and how well it is known.

    Attributes:
        sigma: Standard deviation along it, in metres or radians; near `BELIEF` when free.
        shares: The unknowns that take part, largest first, with their components.
        pair: The two unknowns of the largest components, and their correlation; None if one
            unknown stands alone.
        is_free: Whether the images say less about it than a belief of 100 mm and 100 mrad.
    """

    sigma: float
    shares: dict[str, float]
    pair: Confounding | None
    is_free: bool

    def in_words(self) -> str:
        """Return the direction's name, such as `c0 against t_z (corr +0.99)`."""
        names = list(self.shares)
        if self.pair is None:
            return names[0]
        text = f"{self.pair.first} against {self.pair.second} (corr {self.pair.correlation:+.2f})"
        return text if len(names) == 2 else f"{text}, with {', '.join(names[2:])}"


class Observability(NamedTuple):
    """What the images leave open.

    Attributes:
        directions: Every direction, the weakest first.
        confounded: Pairs of strong correlation, strongest first.
        condition: Condition number of the scaled normal equations.
        covariance: Of all unknowns, with the wide belief, shape (P, P).
        vectors: The directions as unit vectors in the columns, shape (P, P).
    """

    directions: list[Direction]
    confounded: list[Confounding]
    condition: float
    covariance: Tensor
    vectors: Tensor

    @property
    def free(self) -> list[Direction]:
        """The directions that the images leave free."""
        return [direction for direction in self.directions if direction.is_free]

    @property
    def worst_sigma(self) -> float:
        """The weakest direction's sigma, metres or radians."""
        return self.directions[0].sigma


def parameter_symbols(moments: ImageMoments, parameters: Parameters) -> list[str]:
    """Return the names of the unknowns in the order of a step."""
    hand_eye = HAND_EYE_SYMBOLS if parameters.hand_eye_is_free else []
    return [*hand_eye, *moments.symbols]


def effective_variance(
    moments: ImageMoments, optimum: Parameters, covariance: Tensor | None = None
) -> float:
    """Return the variance a residual would have if pixels were as independent as they are not.

    It is the mean squared residual times the design effect: how many times larger the
    leave-one-image-out variance is than that of independent pixels, averaged over directions.
    Without a covariance, or with one of independent pixels, it is the mean squared residual.
    """
    equations = MomentObjective(moments).normal_equations(optimum)
    variance = float(equations.loss / moments.count.sum().clamp(min=1))
    variance = max(variance, _LEAST_RESIDUAL**2)
    if covariance is None:
        return variance
    per_direction = float((covariance * equations.hessian).sum()) / max(optimum.size, 1)
    return max(per_direction, variance)


def information(moments: ImageMoments, optimum: Parameters, variance: float) -> Tensor:
    """Return the precision of the unknowns that the images bring, shape (P, P).

    Curvature that is only rounding is removed, so that a singular direction is exactly singular.
    """
    hessian = MomentObjective(moments).normal_equations(optimum).hessian
    scale = hessian.diagonal().clamp(min=1e-300).sqrt()
    values, vectors = torch.linalg.eigh(hessian / scale[:, None] / scale[None, :])
    values = torch.where(values < _SINGULAR * values.max(), 0.0, values)
    clean = (vectors * values) @ vectors.T
    return clean * scale[:, None] * scale[None, :] / variance


def posterior_covariance(precision: Tensor) -> Tensor:
    """Return the covariance of precision matrices (..., P, P) together with the wide belief."""
    belief = torch.eye(precision.shape[-1], dtype=precision.dtype) / BELIEF**2
    return torch.linalg.inv(precision + belief)


def observability(
    moments: ImageMoments,
    optimum: Parameters,
    covariance: Tensor | None = None,
    threshold: float = 0.95,
) -> Observability:
    """Look for free directions, weak ones and strong correlations in the curvature of the loss.

    Args:
        moments: Moments of the images fitted.
        optimum: The parameters at the optimum.
        covariance: Leave-one-image-out covariance (P, P): how much less than independent
            pixels the images are worth; None takes the pixels as independent.
        threshold: Absolute correlation from which a pair is named.
    """
    names = parameter_symbols(moments, optimum)
    precision = information(moments, optimum, effective_variance(moments, optimum, covariance))
    posterior = posterior_covariance(precision)
    variances, vectors = torch.linalg.eigh(posterior)
    order = variances.argsort(descending=True)
    variances, vectors = variances[order], vectors[:, order]
    num_free = int((variances > 0.5 * BELIEF**2).sum())
    vectors[:, :num_free] = _sparse_basis(vectors[:, :num_free])
    directions = [
        _direction(vectors[:, k], float(variances[k]), posterior, names) for k in range(len(names))
    ]
    return Observability(
        directions, _strong_pairs(posterior, names, threshold), _condition(precision),
        posterior, vectors,
    )  # fmt: skip


def _sparse_basis(basis: Tensor) -> Tensor:
    """Turn an orthonormal basis (P, k) into one of the same space whose vectors are sparse.

    Free directions are equally weak, so that any mixture of them is as good an eigenvector; only
    the ones that concern few unknowns have a name.
    """
    left = basis.clone()
    found: list[Tensor] = []
    for _ in range(basis.shape[1]):
        # The unknown that lies most within what is left of the space, and its share of it.
        inside = left @ left.T
        vector = inside[:, int(inside.diagonal().argmax())]
        vector = vector / vector.norm()
        found.append(vector)
        left = left - vector[:, None] * (vector @ left)
    return torch.stack(found, dim=1) if found else basis


def _direction(vector: Tensor, variance: float, posterior: Tensor, names: list[str]) -> Direction:
    size = vector.abs()
    order = size.argsort(descending=True).tolist()
    named = [k for k in order if size[k] > _NAMED * size.max()]
    pair = None
    if len(named) > 1:
        first, second = sorted(named[:2])
        pair = Confounding(names[first], names[second], _correlation(posterior, first, second))
    shares = {names[k]: float(vector[k]) for k in named}
    return Direction(variance**0.5, shares, pair, is_free=variance > 0.5 * BELIEF**2)


def _correlation(covariance: Tensor, first: int, second: int) -> float:
    spread = covariance.diagonal().sqrt()
    return float(covariance[first, second] / spread[first] / spread[second])


def _strong_pairs(covariance: Tensor, names: list[str], threshold: float) -> list[Confounding]:
    left, right = torch.triu_indices(len(names), len(names), offset=1).tolist()
    pairs = [
        Confounding(names[a], names[b], _correlation(covariance, a, b))
        for a, b in zip(left, right, strict=True)
    ]
    strong = [pair for pair in pairs if abs(pair.correlation) >= threshold]
    return sorted(strong, key=lambda pair: -abs(pair.correlation))


def _condition(precision: Tensor) -> float:
    scale = precision.diagonal().clamp(min=1e-300).sqrt()
    values = torch.linalg.eigvalsh(precision / scale[:, None] / scale[None, :])
    return float(values.max() / values.min().clamp(min=1e-300))
