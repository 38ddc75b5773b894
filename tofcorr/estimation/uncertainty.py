r"""How uncertain an estimate is: by leaving out poses, and by the curvature of the loss.

Pixels of one image share its pose error and its target, so counting them as independent makes
standard errors many times too small. Leaving out one pose at a time does not.

In the curvature, metres and radians are comparable: one milliradian moves a point at one metre by
one millimetre. A direction is a unit vector over all unknowns, and its sigma is the standard
deviation of the result along it. A wide Gaussian prior on every unknown keeps everything defined. A
direction on which the images carry less information than that prior is undetermined.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from tofcorr.errors import CalibrationDataError
from tofcorr.estimation.linear import (
    Curvature,
    NormalEquations,
    left_out_steps,
    robust_covariance,
    unbiased_covariance,
)
from tofcorr.estimation.moments import (
    HAND_EYE_SYMBOLS,
    LEAST_RESIDUAL,
    ImageMoments,
    Parameters,
    Prior,
)
from tofcorr.estimation.planes import Walls, joint_image_equations, marginal

PRIOR_SIGMA = 0.1
"""Standard deviation of the wide prior on every unknown: 100 mm, 100 mrad (5.7 degrees).

It is wider than the error of any depth camera and of any usable hand-eye guess. Set by hand.
"""


@dataclass(frozen=True)
class Covariance:
    """Covariance of a step at the optimum, in the order of `Parameters.moved`.

    Attributes:
        matrix: Shape (P, P); metres and radians for the hand-eye (camera axes), metres for the
            coefficients.
            The variance of directions that the images do not determine is not in it.
        jackknife: The parameters' shift when one pose is left out, shape (G, P).
    """

    matrix: Float[Tensor, "P P"]
    jackknife: Float[Tensor, "G P"]

    @property
    def degrees_of_freedom(self) -> int:
        """Degrees of freedom of Student's t for estimate / standard error: poses less one."""
        return len(self.jackknife) - 1

    def of(self, unknowns: Int[Tensor, "K"]) -> "Covariance":
        """Return the covariance of some of the unknowns."""
        return Covariance(self.matrix[unknowns][:, unknowns], self.jackknife[:, unknowns])


def jackknife_covariance(
    moments: ImageMoments,
    optimum: Parameters,
    prior: Prior | None = None,
    poses: Int[Tensor, "N"] | None = None,
    walls: Walls | None = None,
) -> Covariance:
    """Return the leave-one-pose-out covariance, from one Newton step per pose.

    Args:
        moments: Moments of the images fitted.
        optimum: The parameters at the optimum.
        prior: The prior that was part of the loss; it counts as one more observation.
        poses: The pose of each image, shape (N,), counted from zero: images of one pose share its
            error and are left out together. None: every image has its own.
        walls: Walls that were estimated as well; the covariance allows for them.

    Raises:
        CalibrationDataError: There are fewer than three poses.
    """
    each = joint_image_equations(moments, optimum, walls).by_pose(poses)
    own = None if prior is None else prior.equations(optimum)
    rows = [] if prior is None else [prior.scores]
    return jackknife(each, each.total().plus(own).hessian, rows).of(torch.arange(optimum.size))


def jackknife(
    each: NormalEquations,
    hessian: Float[Tensor, "Q Q"],
    priors: Sequence[Float[Tensor, "Q1 F"]],
    *,
    unbiased: bool = False,
) -> Covariance:
    """Return the leave-one-pose-out covariance of all unknowns of normal equations.

    Args:
        each: Those of each pose, at the optimum.
        hessian: The curvature of all poses and of the priors.
        priors: Standard deviations of the scores of priors on the first unknowns, in the columns.
        unbiased: Whether the covariance is right on average rather than on the safe side. With
            nearly as many unknowns as poses that side is far away.

    Raises:
        CalibrationDataError: There are fewer than three poses.
    """
    if len(each.gradient) < 3:
        raise CalibrationDataError(f"Deviations need at least 3 poses, got {len(each.gradient)}.")
    shift, curvature = left_out_steps(each, hessian)
    matrix = unbiased_covariance(each, curvature) if unbiased else robust_covariance(shift)
    for scores in priors:
        gain = curvature.inverse[:, : len(scores)] @ scores
        matrix = matrix + gain @ gain.T
    return Covariance(matrix, shift)


def effective_variance(
    moments: ImageMoments, optimum: Parameters, each: NormalEquations | None = None
) -> float:
    r"""Return the effective variance of a residual, which allows for correlated pixels.

    Were the pixels independent, the score :math:`g_i` of image i at the optimum would have the
    covariance :math:`s^2 (H_i - H_i H^{-1} H_i)`. The pixels of an image share its pose error and
    its target, so the scores vary more; :math:`s^2` is chosen to match their variation:

    .. math:: s^2 = \sum_i g_i^T H^{-1} g_i \Big/ \sum_i \mathrm{tr}(W_i - W_i^2),
        \quad W_i = H^{-1} H_i

    It is at least the mean squared residual.

    Args:
        moments: Moments of the images fitted.
        optimum: The parameters at the optimum.
        each: The images' normal equations there, with any unknowns after the others; None: they are
            formed.

    Returns:
        The variance in the unit of the loss: square metres where pixels have weight 1.
    """
    each, own = each or joint_image_equations(moments, optimum, None), slice(optimum.size)
    gradient, hessian = each.gradient[:, own], each.hessian[:, own, own]
    least = max(float(each.loss.sum() / moments.count.sum().clamp(min=1)), LEAST_RESIDUAL**2)
    whitening = Curvature(hessian.sum(dim=0)).basis
    scores = gradient @ whitening
    shares = whitening.T @ hessian @ whitening
    freedom = float(shares.diagonal(dim1=1, dim2=2).sum() - shares.square().sum())
    return max(float(scores.square().sum()) / freedom, least) if freedom > 0 else least


def posterior_covariance(precision: Float[Tensor, "*batch P P"]) -> Float[Tensor, "*batch P P"]:
    """Return the covariance (..., P, P) that precision matrices give with the wide prior."""
    prior = torch.eye(precision.shape[-1], dtype=precision.dtype) / PRIOR_SIGMA**2
    return torch.linalg.inv(precision + prior)


class Direction(NamedTuple):
    """A combination of unknowns, and how well it is known.

    Attributes:
        sigma: Standard deviation along it, in metres or radians; near `PRIOR_SIGMA` when
            undetermined.
        shares: The unknowns of the largest components, largest first, with their components.
        correlation: Of the two unknowns of the largest components; None: it is one unknown.
        is_undetermined: Whether the images say less about it than a prior of 100 mm and 100 mrad.
    """

    sigma: float
    shares: dict[str, float]
    correlation: float | None
    is_undetermined: bool

    def in_words(self) -> str:
        """Return the direction's name, such as `c0 and t_z together (corr +0.99)`."""
        names = list(self.shares)
        if self.correlation is None:
            return names[0]
        first_two = "" if len(names) == 2 else " of the first two"
        together = f"{', '.join(names[:-1])} and {names[-1]} together"
        return f"{together} (corr{first_two} {self.correlation:+.2f})"


class Observability(NamedTuple):
    """How well the images determine the unknowns.

    Attributes:
        directions: Every direction, the weakest first.
        confounded: Correlations of pairs that the images hardly separate, strongest first.
        vectors: The directions as unit vectors in the columns, shape (P, P).
        precision: Of all unknowns, without the wide prior, shape (P, P).
        variance: The effective variance of a residual, in the unit of the loss.
    """

    directions: list[Direction]
    confounded: dict[tuple[str, str], float]
    vectors: Tensor
    precision: Tensor
    variance: float

    @property
    def undetermined(self) -> list[Direction]:
        """The directions that the images do not determine."""
        return [direction for direction in self.directions if direction.is_undetermined]


def observability(
    moments: ImageMoments,
    optimum: Parameters,
    prior: Prior | None,
    walls: Walls | None,
    hessian: Float[Tensor, "P P"] | None = None,
) -> Observability:
    """Find undetermined directions, weak ones and strong correlations in the loss's curvature.

    Args:
        moments: Moments of the images fitted.
        optimum: The parameters at the optimum.
        prior: The smoothing penalties, if they were part of the loss; they count as information.
        walls: Walls that were estimated as well.
        hessian: Curvature of the images where more than walls was estimated as well; None: of the
            moments, with the walls.
    """
    names = [*HAND_EYE_SYMBOLS[: optimum.twist_size], *moments.symbols]
    each = joint_image_equations(moments, optimum, walls)
    variance = effective_variance(moments, optimum, each)
    # Curvature that is only rounding is removed: a singular direction is then exactly singular.
    if hessian is None:
        hessian = marginal(each.hessian.sum(dim=0), torch.arange(optimum.size))
    root = Curvature(hessian).root
    precision = root @ root.mT / variance
    if prior is not None:
        precision = precision + prior.equations(optimum).hessian / prior.variance
    posterior = posterior_covariance(precision)
    spread = posterior.diagonal().clamp(min=0.0).sqrt()
    # Rounding makes a variance negative where nothing determines its unknown: no correlation then.
    correlation = (posterior / (spread[:, None] * spread)).nan_to_num(0.0, 0.0, 0.0)
    variances, vectors = torch.linalg.eigh(posterior)
    order = variances.argsort(descending=True)
    # Rounding may leave a variance below zero where the images fit exactly.
    variances, vectors = variances[order].clamp(min=0.0), vectors[:, order]
    # Half of the variance is then the prior's.
    undetermined = int((variances > PRIOR_SIGMA**2 / 2).sum())
    vectors[:, :undetermined] = sparse_basis(vectors[:, :undetermined])
    left, right = torch.triu_indices(len(names), len(names), offset=1)
    order = correlation[left, right].abs().argsort(descending=True)
    # The standard errors of such a pair are more than three times those of either alone.
    order = order[20 * correlation[left, right][order].abs() >= 19]
    pairs = {
        (names[a], names[b]): float(correlation[a, b])
        for a, b in zip(left[order].tolist(), right[order].tolist(), strict=True)
    }

    def direction(k: int) -> Direction:
        shares = named_components(vectors[:, k], names)
        first = [names.index(name) for name in list(shares)[:2]]
        both = float(correlation[first[0], first[1]]) if len(first) > 1 else None
        return Direction(float(variances[k]) ** 0.5, shares, both, k < undetermined)

    directions = [direction(k) for k in range(len(names))]
    return Observability(directions, pairs, vectors, precision, variance)


def sparse_basis(basis: Float[Tensor, "P k"]) -> Float[Tensor, "P k"]:
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


def named_components(vector: Float[Tensor, "P"], names: list[str]) -> dict[str, float]:
    """Return the unknowns of the largest components, largest first, with their components.

    Components below a fifth of the largest are left out.
    """
    size = vector.abs().tolist()
    # Of equal ones the first comes first, whatever their rounding.
    order = sorted(range(len(names)), key=lambda k: -round(size[k], 9))
    named = [k for k in order if 5 * size[k] > max(size)]
    return {names[k]: float(vector[k]) for k in named}


def prior_on_undetermined(found: Observability, guess: Parameters) -> Prior | None:
    """Return a prior of 100 mm and 100 mrad around the guess along the undetermined directions.

    What the images do determine stays as it is.

    Args:
        found: How well the images determine each direction.
        guess: The start; its coefficients count as well.

    Returns:
        The prior; None if every direction is determined.
    """
    names = [one.in_words() for one in found.undetermined]
    if not names:
        return None
    factor = found.vectors[:, : len(names)].T.contiguous() / PRIOR_SIGMA
    return Prior(guess, factor, found.variance, names)


def worst_sigma(covariance: Tensor) -> float:
    """Return the largest standard deviation of any direction, metres or radians."""
    return float(torch.linalg.eigvalsh(covariance)[-1].clamp(min=0).sqrt())


def worst_axes(covariance: Tensor) -> tuple[float, float]:
    """Return those of the translation (m) and of the rotation (rad) of a hand-eye transform."""
    return worst_sigma(covariance[:3, :3]), worst_sigma(covariance[3:6, 3:6])
