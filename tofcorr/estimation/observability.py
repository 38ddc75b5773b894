r"""What the images cannot tell: directions left free, and parameters told apart only barely.

Metres and radians are commensurate here: one milliradian moves a point at one metre by one
millimetre. A direction is a unit vector over all unknowns, and its sigma says how far the result
may be off along it. A wide Gaussian belief about every unknown keeps everything defined; where the
images say less than that belief, they leave the direction free.
"""

from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from tofcorr.estimation.moments import ImageMoments
from tofcorr.estimation.objective import MomentObjective, NormalEquations
from tofcorr.estimation.parameters import HAND_EYE_SYMBOLS, Parameters
from tofcorr.estimation.planes import Walls, marginal_hessian

BELIEF = 0.1
"""Standard deviation of the wide belief about every unknown: 100 mm, 100 mrad (5.7 degrees)."""

# Curvature relative to the largest (each parameter scaled to its own) that is only rounding.
_SINGULAR = 1e-10
# Components of a direction that are worth naming, relative to the largest.
_NAMED = 0.2
# Residuals are never believed to be better known than this (metres): data without any noise would
# otherwise make rounding look like information.
_LEAST_RESIDUAL = 1e-5


class Belief(Protocol):
    """What is believed of the unknowns besides what the images tell."""

    @property
    def variance(self) -> float:
        """The effective variance of a residual that it is scaled to."""
        ...

    def equations(self, parameters: Parameters, /) -> NormalEquations:
        """Return its part of the normal equations."""
        ...


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
        precision: Of all unknowns, without the belief, shape (P, P).
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


def effective_variance(moments: ImageMoments, optimum: Parameters) -> float:
    r"""Return the variance a residual would have if pixels were as independent as they are not.

    Were every pixel independent, the score :math:`g_i` of image i at the optimum would vary by
    :math:`s^2 (H_i - H_i H^{-1} H_i)`. The scores of whole images, which share their pose error
    and their target, say how large the variance s^2 would have to be:

    .. math:: s^2 = \sum_i g_i^T H^{-1} g_i \Big/ \sum_i \mathrm{tr}(W_i - W_i^2),
        \quad W_i = H^{-1} H_i

    It is at least the mean squared residual.
    """
    each = MomentObjective(moments).image_equations(optimum)
    least = max(float(each.loss.sum() / moments.count.sum().clamp(min=1)), _LEAST_RESIDUAL**2)
    scale, values, vectors = _scaled_eigh(each.hessian.sum(dim=0))
    known = values > 0
    whitening = vectors[:, known] / values[known].sqrt() / scale[:, None]
    scores = each.gradient @ whitening
    shares = whitening.T @ each.hessian @ whitening
    freedom = float(shares.diagonal(dim1=1, dim2=2).sum() - shares.square().sum())
    return max(float(scores.square().sum()) / freedom, least) if freedom > 0 else least


def information(
    moments: ImageMoments, optimum: Parameters, variance: float, walls: Walls | None = None
) -> Tensor:
    """Return the precision of the unknowns that the images bring, shape (P, P).

    Walls that are unknown as well take some of it.

    Curvature that is only rounding is removed, so that a singular direction is exactly singular.
    """
    scale, values, vectors = _scaled_eigh(marginal_hessian(moments, optimum, walls))
    clean = (vectors * values) @ vectors.T
    return clean * scale[:, None] * scale[None, :] / variance


def _scaled_eigh(hessian: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return scale, eigenvalues and eigenvectors of a Hessian of unit diagonal; rounding as 0."""
    scale = hessian.diagonal().clamp(min=1e-300).sqrt()
    values, vectors = torch.linalg.eigh(hessian / scale[:, None] / scale[None, :])
    return scale, torch.where(values < _SINGULAR * values.max(), 0.0, values), vectors


def posterior_covariance(precision: Tensor) -> Tensor:
    """Return the covariance of precision matrices (..., P, P) together with the wide belief."""
    belief = torch.eye(precision.shape[-1], dtype=precision.dtype) / BELIEF**2
    return torch.linalg.inv(precision + belief)


def observability(
    moments: ImageMoments,
    optimum: Parameters,
    threshold: float = 0.95,
    belief: Belief | None = None,
    walls: Walls | None = None,
) -> Observability:
    """Look for free directions, weak ones and strong correlations in the curvature of the loss.

    Args:
        moments: Moments of the images fitted.
        optimum: The parameters at the optimum.
        threshold: Absolute correlation from which a pair is named.
        belief: That curves are smooth, if that was part of the loss; it counts as information.
        walls: Walls that were estimated as well.
    """
    names = parameter_symbols(moments, optimum)
    variance = effective_variance(moments, optimum)
    precision = information(moments, optimum, variance, walls)
    if belief is not None:
        precision = precision + belief.equations(optimum).hessian / belief.variance
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
        directions,
        _strong_pairs(posterior, names, threshold),
        _condition(precision),
        posterior,
        vectors,
        precision,
        variance,
    )


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
