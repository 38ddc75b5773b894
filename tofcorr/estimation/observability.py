r"""Which directions of the unknowns the images determine, and which parameters they separate.

Metres and radians are comparable here: one milliradian moves a point at one metre by one
millimetre. A direction is a unit vector over all unknowns, and its sigma is the standard deviation
of the result along it. A wide Gaussian prior on every unknown keeps everything defined. A direction
on which the images carry less information than that prior is undetermined.
"""

from typing import NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from tofcorr.estimation.information import (
    PRIOR_SIGMA,
    effective_variance,
    information,
    posterior_covariance,
)
from tofcorr.estimation.linear import NormalEquations
from tofcorr.estimation.moments import ImageMoments
from tofcorr.estimation.parameters import HAND_EYE_SYMBOLS, Parameters
from tofcorr.estimation.planes import Walls

# Components of a direction below this share of the largest are left out of its name. Set by hand.
_NAMED = 0.2


@runtime_checkable
class QuadraticPrior(Protocol):
    """What is known of the unknowns apart from the images, as a sum of squares."""

    @property
    def variance(self) -> float:
        """The effective variance of a residual that it is scaled to."""
        ...

    def equations(self, parameters: Parameters, /) -> NormalEquations:
        """Return its part of the normal equations."""
        ...


class Confounding(NamedTuple):
    """Two parameters that the images hardly separate."""

    first: str
    second: str
    correlation: float


class Direction(NamedTuple):
    """A combination of unknowns, and how well it is known.

    Attributes:
        sigma: Standard deviation along it, in metres or radians; near `PRIOR_SIGMA` when
            undetermined.
        shares: The unknowns of the largest components, largest first, with their components.
        pair: The two unknowns of the largest components, and their correlation; None if the
            direction is one unknown.
        is_undetermined: Whether the images say less about it than a prior of 100 mm and 100 mrad.
    """

    sigma: float
    shares: dict[str, float]
    pair: Confounding | None
    is_undetermined: bool

    def in_words(self) -> str:
        """Return the direction's name, such as `c0 and t_z together (corr +0.99)`."""
        names = list(self.shares)
        if self.pair is None:
            return names[0]
        first_two = "" if len(names) == 2 else " of the first two"
        return (
            f"{', '.join(names[:-1])} and {names[-1]} together "
            f"(corr{first_two} {self.pair.correlation:+.2f})"
        )


class Observability(NamedTuple):
    """How well the images determine the unknowns.

    Attributes:
        directions: Every direction, the weakest first.
        confounded: Pairs of strong correlation, strongest first.
        condition: Condition number of the scaled normal equations.
        covariance: Of all unknowns, with the wide prior, shape (P, P).
        vectors: The directions as unit vectors in the columns, shape (P, P).
        precision: Of all unknowns, without the wide prior, shape (P, P).
        variance: The effective variance of a residual, in the unit of the loss.
    """

    directions: list[Direction]
    confounded: list[Confounding]
    condition: float
    covariance: Tensor
    vectors: Tensor
    precision: Tensor
    variance: float

    @property
    def undetermined(self) -> list[Direction]:
        """The directions that the images do not determine."""
        return [direction for direction in self.directions if direction.is_undetermined]

    @property
    def worst_sigma(self) -> float:
        """The weakest direction's sigma, metres or radians."""
        return self.directions[0].sigma


def parameter_symbols(moments: ImageMoments, parameters: Parameters) -> list[str]:
    """Return the names of the unknowns in the order of a step."""
    hand_eye = HAND_EYE_SYMBOLS if parameters.hand_eye_is_free else []
    return [*hand_eye, *moments.symbols]


def observability(
    moments: ImageMoments,
    optimum: Parameters,
    threshold: float = 0.95,
    prior: QuadraticPrior | None = None,
    walls: Walls | None = None,
) -> Observability:
    """Find undetermined directions, weak ones and strong correlations in the loss's curvature.

    Args:
        moments: Moments of the images fitted.
        optimum: The parameters at the optimum.
        threshold: Absolute correlation from which a pair is reported. The default, 0.95, is set by
            hand: the standard errors of such a pair are more than three times those of either
            parameter alone.
        prior: The smoothing penalties, if they were part of the loss; they count as information.
        walls: Walls that were estimated as well.
    """
    names = parameter_symbols(moments, optimum)
    variance = effective_variance(moments, optimum)
    precision = information(moments, optimum, variance, walls)
    if prior is not None:
        precision = precision + prior.equations(optimum).hessian / prior.variance
    posterior = posterior_covariance(precision)
    variances, vectors = torch.linalg.eigh(posterior)
    order = variances.argsort(descending=True)
    # Rounding may leave a variance below zero where the images fit exactly.
    variances, vectors = variances[order].clamp(min=0.0), vectors[:, order]
    undetermined = int(sum(_is_undetermined(float(one)) for one in variances))
    vectors[:, :undetermined] = _sparse_basis(vectors[:, :undetermined])
    directions = [
        _direction(vectors[:, k], float(variances[k]), posterior, names) for k in range(len(names))
    ]
    return Observability(
        directions,
        _strong_pairs(posterior, names, threshold),
        _condition(precision),
        posterior,
        vectors,
        precision,
        variance,
    )


def _is_undetermined(variance: float) -> bool:
    """Whether more than half of a posterior variance is the prior's: the images carry less."""
    return variance > 0.5 * PRIOR_SIGMA**2


def _sparse_basis(basis: Float[Tensor, "P k"]) -> Float[Tensor, "P k"]:
    """Turn an orthonormal basis (P, k) into one of the same space whose vectors are sparse.

    Undetermined directions are equally weak, so that any mixture of them is an eigenvector as
    well. Mixtures of few unknowns can be named.
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


def _direction(
    vector: Float[Tensor, "P"], variance: float, posterior: Float[Tensor, "P P"], names: list[str]
) -> Direction:
    size = vector.abs()
    order = size.argsort(descending=True).tolist()
    named = [k for k in order if size[k] > _NAMED * size.max()]
    pair = None
    if len(named) > 1:
        first, second = sorted(named[:2])
        pair = Confounding(names[first], names[second], _correlation(posterior, first, second))
    shares = {names[k]: float(vector[k]) for k in named}
    return Direction(variance**0.5, shares, pair, _is_undetermined(variance))


def _correlation(covariance: Float[Tensor, "P P"], first: int, second: int) -> float:
    spread = covariance.diagonal().clamp(min=1e-300).sqrt()
    return float(covariance[first, second] / spread[first] / spread[second])


def _strong_pairs(
    covariance: Float[Tensor, "P P"], names: list[str], threshold: float
) -> list[Confounding]:
    left, right = torch.triu_indices(len(names), len(names), offset=1).tolist()
    pairs = [
        Confounding(names[a], names[b], _correlation(covariance, a, b))
        for a, b in zip(left, right, strict=True)
    ]
    strong = [pair for pair in pairs if abs(pair.correlation) >= threshold]
    return sorted(strong, key=lambda pair: -abs(pair.correlation))


def _condition(precision: Float[Tensor, "P P"]) -> float:
    scale = precision.diagonal().clamp(min=1e-300).sqrt()
    values = torch.linalg.eigvalsh(precision / scale[:, None] / scale[None, :])
    return float(values.max() / values.min().clamp(min=1e-300))
