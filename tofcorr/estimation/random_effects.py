r"""Linear least squares where every group of data has random effects of its own.

The data of group g are :math:`y_g = X_g \beta + N_g u_g + \epsilon_g`, with
:math:`u_g \sim N(0, T)`, :math:`\epsilon \sim N(0, \sigma^2 / w)` and a Gaussian prior on
:math:`\beta`. Everything is computed from each group's sums of products of
:math:`(X_g, N_g, y_g)`, so that the data are read once. The variances are found by expectation
maximisation of the marginal likelihood (Laird and Ware 1982), in the form of MacKay (1992), which
has the same fixed point and does not stall at variances that are far too small.
"""

from typing import NamedTuple

import torch
from torch import Tensor

# Most steps. Chosen: splits of a Kinect v2's recording settled in 10 to 40.
_STEPS = 60
# Largest change of the logarithm of a variance in a step at which it counts as settled. Chosen: a
# standard deviation is then known far better than the data determine it.
_SETTLED = 0.01
# Largest variance of an effect or of a prior, square metres or radians: 50 mm or mrad. Chosen: what
# is larger is no error of a camera or a robot, but two effects of opposite signs.
_LARGEST = 0.05**2
# Share of its mean diagonal added to a matrix before it is factored: rounding of float64 sums.
_RIDGE = 1e-12


class GroupSums(NamedTuple):
    """Weighted sums of products of the columns of each group.

    Attributes:
        products: Shape (G, S, S), in the order: P unknowns, R random effects, the observation.
        size: Observations of each group, shape (G,).
        random: R.
    """

    products: Tensor
    size: Tensor
    random: int

    @property
    def unknowns(self) -> int:
        """P, how many unknowns the groups share."""
        return self.products.shape[1] - self.random - 1


class Reduced(NamedTuple):
    """Normal equations of each group in the shared unknowns, random effects integrated out.

    Attributes:
        precision: Shape (G, P, P).
        right: Shape (G, P).
    """

    precision: Tensor
    right: Tensor


class Variances(NamedTuple):
    """What the spread of the data says.

    Attributes:
        noise: Variance of an observation of weight 1.
        random: Of each random effect, shape (R,).
        unknowns: Prior variance of each unknown, shape (P,); infinite: no prior.
    """

    noise: float
    random: Tensor
    unknowns: Tensor


class Estimate(NamedTuple):
    """The shared unknowns.

    Attributes:
        mean: Shape (P,).
        covariance: Shape (P, P).
        variances: With which they were estimated.
    """

    mean: Tensor
    covariance: Tensor
    variances: Variances


class Classes(NamedTuple):
    """Which variances are one, and what was believed of them before.

    Attributes:
        of_random: Class of each random effect, shape (R,).
        of_unknown: Class of each unknown, shape (P,); -1: its prior is not estimated.
        believed_random: Variance of each class before any data, which counts as one more effect.
        believed_unknown: The same for the classes of the unknowns.
        largest_random: Largest variance of each class of effects.
    """

    of_random: Tensor
    of_unknown: Tensor
    believed_random: Tensor
    believed_unknown: Tensor
    largest_random: Tensor


def reduced(sums: GroupSums, noise: Tensor, random_precision: Tensor) -> Reduced:
    """Integrate the random effects out.

    Args:
        sums: Of each group.
        noise: Variance of an observation of weight 1, in each group, shape (G,).
        random_precision: One over the variance of each effect, shape (R,) or (G, R); 0: unknown.
    """
    own, cross, shared, right = _parts(sums)
    within = _with_prior(own[:, :, :-1], noise, random_precision)
    # Turns and shifts have other units than shapes: scaled, nothing is lost to rounding.
    scale = within.diagonal(dim1=1, dim2=2).rsqrt()[:, :, None]
    right_sides = torch.cat([cross, own[:, :, -1:]], dim=2)
    solved = scale * torch.linalg.solve(within * scale * scale.transpose(1, 2), scale * right_sides)
    products = shared - cross.transpose(1, 2) @ solved[:, :, :-1]
    rest = right - (cross.transpose(1, 2) @ solved[:, :, -1:])[:, :, 0]
    return Reduced(products / noise[:, None, None], rest / noise[:, None])


def estimate(sums: GroupSums, prior_precision: Tensor, start: Variances, of: Classes) -> Estimate:
    """Estimate the unknowns and the variances together.

    Args:
        sums: Of each group.
        prior_precision: A fixed prior of mean zero on the unknowns, shape (P, P).
        start: Where the variances start.
        of: Which of them are one.
    """
    variances = start
    for _ in range(_STEPS):
        before = variances
        variances = _updated(sums, unknowns_given(sums, prior_precision, before), of)
        if _change(before, variances) < _SETTLED:
            break
    return unknowns_given(sums, prior_precision, variances)


def _change(before: Variances, after: Variances) -> float:
    known = before.unknowns.isfinite()
    pairs = (before.random, after.random), (before.unknowns[known], after.unknowns[known])
    changes = [(new / old).log().abs().max() for old, new in pairs if len(old)]
    return float(torch.stack(changes).max())


def unknowns_given(sums: GroupSums, prior_precision: Tensor, variances: Variances) -> Estimate:
    """Estimate the unknowns with given variances; arguments as of `estimate`."""
    noise = torch.full_like(sums.size, variances.noise)
    groups = reduced(sums, noise, 1 / variances.random)
    precision = groups.precision.sum(dim=0) + prior_precision + (1 / variances.unknowns).diag()
    covariance = inverse(precision)
    return Estimate(covariance @ groups.right.sum(dim=0), covariance, variances)


def random_effects(sums: GroupSums, found: Estimate) -> tuple[Tensor, Tensor]:
    """Return the effects of each group, and the variances that they are uncertain by.

    Args:
        sums: Of each group.
        found: The shared unknowns.

    Returns:
        Two tensors of shape (G, R).
    """
    noise = found.variances.noise
    own, cross, _, _ = _parts(sums)
    precision = 1 / found.variances.random
    within = _with_prior(own[:, :, :-1], torch.full_like(sums.size, noise), precision)
    spread = torch.linalg.inv(within)
    effects = (spread @ (own[:, :, -1] - cross @ found.mean)[:, :, None])[:, :, 0]
    lever = spread @ cross
    uncertainty = noise * spread.diagonal(dim1=1, dim2=2)
    return effects, uncertainty + (lever @ found.covariance * lever).sum(dim=2)


def _updated(sums: GroupSums, found: Estimate, of: Classes) -> Variances:
    """Return the variances that the squares of unknowns, effects and residuals suggest."""
    before = found.variances
    effects, uncertainty = random_effects(sums, found)
    known = 1 - uncertainty / before.random
    random = _by_class(effects.square().sum(0), known.sum(0), of.of_random, of.believed_random)
    random = torch.minimum(random, of.largest_random[of.of_random])
    known = 1 - found.covariance.diagonal() / before.unknowns
    unknowns = _by_class(found.mean.square(), known, of.of_unknown, of.believed_unknown)
    ones = torch.ones(len(effects), 1).to(effects)
    solution = torch.cat([-found.mean.expand(len(effects), -1), -effects, ones], dim=1)
    rest = (solution[:, None, :] @ sums.products @ solution[:, :, None]).sum()
    freedom = sums.size.sum() - effects.numel() - sums.unknowns
    return Variances(float(rest / freedom.clamp(min=1)), random, unknowns)


def _by_class(squares: Tensor, known: Tensor, of: Tensor, believed: Tensor) -> Tensor:
    """Return the variance of each class at each of its members; infinite where of is -1.

    Args:
        squares: Sum of the squares of each member's values.
        known: How many of these values the data determine, rather than the variance itself.
        of: Class of each member.
        believed: Of each class, see `Classes`.
    """
    variance = torch.full_like(squares, torch.inf)
    for number, before in enumerate(believed):
        own = of == number
        found = (squares[own].sum() + before) / (known[own].sum().clamp(min=0) + 1)
        variance[own] = found.clamp(max=_LARGEST)
    return variance


def _parts(sums: GroupSums) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return products of the effects (with themselves and y), with X, of X, and of X and y."""
    first, last = sums.unknowns, sums.unknowns + sums.random
    products = sums.products
    return (
        products[:, first:last, first:],
        products[:, first:last, :first],
        products[:, :first, :first],
        products[:, :first, -1],
    )


def _with_prior(own: Tensor, noise: Tensor, precision: Tensor) -> Tensor:
    ridge = _RIDGE * own.diagonal(dim1=1, dim2=2).mean(dim=1)[:, None]
    return own + (noise[:, None] * precision + ridge).diag_embed()


def inverse(precision: Tensor) -> Tensor:
    """Return the inverse of a positive definite matrix, scaled to unit diagonal before."""
    scale = precision.diagonal().clamp(min=1e-300).rsqrt()
    scaled = precision * scale[:, None] * scale[None, :]
    scaled = scaled + _RIDGE * torch.eye(len(scaled)).to(scaled)
    return torch.cholesky_inverse(torch.linalg.cholesky(scaled)) * scale[:, None] * scale[None, :]
