r"""Solutions of normal equations.

The sums of each pose, with the uncertainty of the poses included.

For the poses u (frames taken without moving belong together) and all columns X of base model and
effects, with residual y of the base fit, there are two kinds of sums

    A_u = X' W X,   b_u = X' W y.

*Even* sums weigh all pixels alike. Their fit has the smallest residual in millimetres, so sizes
are computed from them. *Likely* sums weigh by likelihood, W = V^-1 with

    V_u = f diag(sigma^2) + Z S Z',

where Z holds the offset and two tilts by which the pose of camera or target is uncertain,
independent for each pose, with covariance S. The dispersion f is the variance of the poses' scores
over the variance that independent pixel noise would give. Likely sums detect the smallest effects,
so significance is computed from them. They do not measure size: real noise is correlated, and no
model is complete. Every fold, subset of columns, bootstrap and sign flip is a sum of such matrices.

Predictions of units that are left out of the fit one by one.

Normal equations in which the columns of a model are eliminated, once for all further effects.

Effects that are tested as additions to one model differ in their own columns alone. With columns m
of the model and e of an effect, the equations N theta = b have the solution

.. math:: Z = N_{mm}^{-1} N_{me}, \quad S = N_{ee} - N_{em} Z, \quad s = b_e - Z^T b_m,

.. math:: \theta_e = S^{-1} s, \quad \theta_m = N_{mm}^{-1} b_m - Z \theta_e .

The effect lowers chi-squared by s' S^-1 s below that of the model alone. The factors of one N_mm
serve all effects; each then needs a system of its own few columns.

The linear system of a model: its columns, its residual, and their sums over each pose.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import NamedTuple

import torch
from torch import Tensor

from tofcorr.diagnosis.sums.base_fit import BaseFit
from tofcorr.diagnosis.sums.base_model import unknown_amplitude_columns
from tofcorr.diagnosis.sums.columns import (
    NUM_POSE,
    Columns,
    Layout,
    Moments,
    blocks_between,
    gather_moments,
    pose_columns,
    with_changed,
)
from tofcorr.diagnosis.sums.noise import MAD_TO_SIGMA
from tofcorr.diagnosis.sums.observations import Observations
from tofcorr.pixels.threads import in_threads
from tofcorr.simulation.effects.inputs import EffectInputs


def solve_positive(matrix: Tensor, right: Tensor) -> Tensor:
    """Solve symmetric positive definite systems (..., K, K) for right sides (..., K, R).

    Raises:
        torch.linalg.LinAlgError: A matrix is singular.
    """
    return solver(matrix)(right)


def solver(matrix: Tensor) -> Callable[[Tensor], Tensor]:
    """Return what solves systems of `solve_positive` for any right sides (..., K, R).

    Cholesky's factors take half the time of Gauss's. Where rounding leaves a matrix that is not
    positive, as in recordings without noise, the general solution is used.
    """
    factor, failed = torch.linalg.cholesky_ex(matrix)
    if bool(failed.any()):
        return partial(torch.linalg.solve, matrix)
    return lambda right: torch.cholesky_solve(right, factor)


def inverse_squares(matrix: Tensor, right: Tensor) -> Tensor:
    """Return r' A^-1 r of positive definite A (..., K, K) for each column r of (..., K, R).

    Half the work of a solution. Returns shape (..., R); errors as in `solve_positive`.
    """
    factor, failed = torch.linalg.cholesky_ex(matrix)
    if bool(failed.any()):
        return (right * torch.linalg.solve(matrix, right)).sum(-2)
    return torch.linalg.solve_triangular(factor, right, upper=False).square().sum(-2)


# Least standard deviation of a pose's offset and tilts, metres. Chosen: far below what robots
# repeat, and enough to keep systems regular.
_LEAST_POSE_SD = 2e-5
# Standard deviation of a pose's offset and tilts in the fit that their uncertainty is estimated
# from, metres. Chosen.
_ASSUMED_POSE_SD = 1e-3
EVEN_SD = 1e-3
"""Even sums weigh a mean pose as one value with this standard deviation, metres. Chosen: 1 mm."""
# Least share of degrees of freedom in a pose that the fit has not used. It bounds the correction of
# the pose variance for recordings of few poses; chosen.
_LEAST_FREEDOM = 0.3
# At most this many coefficients of the model count as determined by the poses' own offsets. Chosen.
_MOST_COUNTED = 12


@dataclass(frozen=True, kw_only=True)
class Sums:
    """Normal equations of every pose, with one kind of weights.

    Attributes:
        gram: A_u, shape (U, P, P).
        score: b_u, shape (U, P).
        layout: Which columns belong to what.
    """

    gram: Tensor
    score: Tensor
    layout: Layout

    @cached_property
    def total(self) -> Tensor:
        """Sum of A_u over all poses, shape (P, P)."""
        return self.gram.sum(0)

    def of(self, names: Sequence[str]) -> tuple[Tensor, Tensor, Tensor]:
        """Return A_u, b_u and prior precision (K, K) of base model and some effects."""
        spans = self.layout.spans(names)
        gram = blocks_between(self.gram, spans)
        score = torch.cat([self.score[:, slice(*span)] for span in spans], dim=1)
        return gram, score, self.layout.prior_of(self.layout.of(names))

    def rows(self, names: Sequence[str]) -> Tensor:
        """Return the rows of A_u that belong to base model and some effects, shape (U, K, P)."""
        return torch.cat([self.gram[:, slice(*span)] for span in self.layout.spans(names)], dim=1)


@dataclass(frozen=True, kw_only=True)
class Blocks:
    """Even and likely sums of every pose.

    Attributes:
        even: Sums with even weights; a pose weighs as much as one value known to 1 mm.
        likely: Sums weighted by likelihood.
        even_scale: What the even sums were multiplied by, 1 / m^2.
        square: Sum of squared residuals of the base fit with even weights, shape (U,), m^2.
        count: Sum of even weights, shape (U,).
        dispersion: The dispersion f, at least 1.
        pose_sd: Standard deviations of offset and tilts, shape (3,), metres (tilts: 0.3 m from the
            centre of what a frame shows).
    """

    even: Sums
    likely: Sums
    even_scale: float
    square: Tensor
    count: Tensor
    dispersion: float
    pose_sd: Tensor

    @property
    def num_units(self) -> int:
        """Number of poses."""
        return len(self.count)

    @property
    def layout(self) -> Layout:
        """Which columns belong to what."""
        return self.even.layout


def with_pose_uncertainty(
    moments: Moments, chosen: Sequence[str] = (), before: Blocks | None = None
) -> Blocks:
    """Estimate the uncertainty of the poses, and return the sums that include it.

    Args:
        moments: Sums over the pixels.
        chosen: Effects of the model.
        before: Those of the same moments with another model; None: there are none.
    """
    dispersion = _dispersion(moments, chosen)
    scale = 1.0 / (float(moments.count.mean()) * EVEN_SD**2)
    pose_sd = _pose_sd(moments, chosen, dispersion)
    if before is None:
        return blocks_of(moments, pose_sd, dispersion, scale)
    likely = likely_sums(moments, pose_sd, dispersion)
    return replace(before, likely=likely, dispersion=dispersion, pose_sd=pose_sd)


def blocks_of(moments: Moments, pose_sd: Tensor, dispersion: float, scale: float) -> Blocks:
    """Return both kinds of sums for a known uncertainty of the poses."""
    last = moments.plain.shape[-1] - 1
    first_z = last - NUM_POSE
    return Blocks(
        even=Sums(
            gram=scale * moments.plain[:, :first_z, :first_z],
            score=scale * moments.plain[:, :first_z, last],
            layout=moments.layout,
        ),
        likely=likely_sums(moments, pose_sd, dispersion),
        even_scale=scale,
        square=moments.plain[:, last, last],
        count=moments.count,
        dispersion=dispersion,
        pose_sd=pose_sd,
    )


def likely_sums(moments: Moments, pose_sd: Tensor, dispersion: float) -> Sums:
    """Return sums weighted by likelihood, given the poses' uncertainty and the factor f."""
    last = moments.weighted.shape[-1] - 1
    first_z = last - NUM_POSE
    columns, pose = slice(first_z), slice(first_z, last)
    cross = moments.weighted[:, pose, :] / dispersion
    inner = cross[:, :, pose] + torch.diag(pose_sd**-2)
    solved = torch.linalg.solve(inner, cross)
    by_pose = cross[:, :, columns].mT

    def reduced(to: slice) -> Tensor:
        whole = moments.weighted[:, columns, to]
        return torch.baddbmm(whole, by_pose, solved[:, :, to], beta=1 / dispersion, alpha=-1)

    return Sums(
        gram=reduced(columns), score=reduced(slice(last, None))[..., 0], layout=moments.layout
    )


def _dispersion(moments: Moments, chosen: Sequence[str]) -> float:
    """Return the variance of the poses' scores over that which pixel noise gives, at least 1.

    Every column outside the model gives one ratio. Their median is insensitive to the few columns
    in which a missing effect shows.
    """
    members = moments.layout.of(chosen)
    last = moments.weighted.shape[-1] - 1
    columns, pose = slice(last - NUM_POSE), slice(last - NUM_POSE, last)
    cross = moments.weighted[:, pose]
    solved = torch.linalg.solve(cross[:, :, pose] + torch.diag(_assumed_sd() ** -2), cross)
    # The likely sums of the model's columns, of the residual, and of each column with itself.
    rows = moments.weighted[:, members] - cross[:, :, members].mT @ solved
    score = moments.weighted[:, last] - (cross[:, :, last:].mT @ solved)[:, 0]
    expected = moments.weighted.diagonal(dim1=1, dim2=2) - (cross * solved).sum(1)
    normal = rows[:, :, members].sum(0) + moments.layout.prior_of(members)
    theta = torch.linalg.solve(normal, rows[:, :, last].sum(0))
    left = (score - theta @ rows)[:, columns]
    total = expected[:, columns].sum(0)
    outside = total > 0
    outside[members] = False
    if not bool(outside.any()):
        return 1.0
    ratio = (left**2).sum(0)[outside] / total[outside]
    return max(float(ratio.median()), 1.0)


def _pose_sd(moments: Moments, chosen: Sequence[str], dispersion: float) -> Tensor:
    """Estimate the standard deviations robustly from the poses' own offsets and tilts.

    The fit assumes poses known to a millimetre. Estimating fit and uncertainty in turn can diverge:
    less certain poses let the hand-eye transform drift, and then look less certain still.
    """
    moments = moments.of(chosen)
    last = moments.weighted.shape[-1] - 1
    z = slice(last - NUM_POSE, last)
    count = last - NUM_POSE
    freedom = max(_LEAST_FREEDOM, 1.0 - min(count, _MOST_COUNTED) / max(len(moments.count), 1))
    certain = _assumed_sd()
    theta = solve(likely_sums(moments, certain, dispersion), chosen)
    cross = moments.weighted[:, z, :] / dispersion
    score = cross[:, :, last] - cross[:, :, :count] @ theta
    inner = cross[:, :, z]
    enough = torch.linalg.matrix_rank(inner) == NUM_POSE
    if not bool(enough.any()):
        return certain
    own = torch.linalg.solve(inner[enough], score[enough])
    noise = torch.linalg.inv(inner[enough]).diagonal(dim1=1, dim2=2)
    spread = (MAD_TO_SIGMA * own.abs().median(dim=0).values) ** 2 / freedom
    return (spread - noise.median(dim=0).values).clamp(min=_LEAST_POSE_SD**2).sqrt()


def _assumed_sd() -> Tensor:
    return torch.full((NUM_POSE,), _ASSUMED_POSE_SD, dtype=torch.float64)


def solve(sums: Sums, names: Sequence[str]) -> Tensor:
    """Return the coefficients of base model and some effects, fitted to all poses, shape (K,)."""
    members = sums.layout.of(names)
    normal = sums.total[members][:, members] + sums.layout.prior_of(members)
    return torch.linalg.solve(normal, sums.score[:, members].sum(0))


LEFT_OUT = tuple((1 + math.cos((2 * k + 1) * math.pi / 6)) / 2 for k in range(3))
"""Shares of a unit that are left out of the fits whose mean predicts it: the three nodes of the
Gauss-Chebyshev quadrature on [0, 1]. Derived in `left_out_solutions`."""


def left_out_squares(blocks: Blocks, names: Sequence[str]) -> Tensor:
    """Return the even sum of squares of each unit, predicted by all others, shape (U,), m^2.

    Args:
        blocks: Sums of every unit.
        names: Effects of the model.
    """
    return squares_at(blocks, names, left_out_coefficients(blocks.even, names))


def squares_at(blocks: Blocks, names: Sequence[str], coefficients: Tensor) -> Tensor:
    """Return the even sum of squares of each unit at given coefficients, shape (U,), m^2.

    Args:
        blocks: Sums of every unit.
        names: Effects of the model.
        coefficients: Of base model and effects, for every unit, shape (U, K).
    """
    gram, score, _ = blocks.even.of(names)
    curved = (gram @ coefficients[:, :, None])[..., 0]
    return blocks.square - (coefficients * (2 * score - curved)).sum(1) / blocks.even_scale


def left_out_coefficients(sums: Sums, names: Sequence[str]) -> Tensor:
    """Return for every unit the coefficients that all others give, shape (U, K)."""
    gram, score, prior = sums.of(names)
    others = gram.sum(0) + prior - gram, (score.sum(0) - score)[:, :, None]
    return solve_positive(*others)[..., 0]


def left_out_solutions(sums: Sums, names: Sequence[str]) -> Tensor:
    r"""Return for every unit the coefficients that give its residual the variance of its error.

    A unit of leverage h has an in-sample residual that is too small by sqrt(1 - h), and a
    leave-one-out residual that is too large by 1 / sqrt(1 - h) (Bell and McCaffrey 2002). Leaving
    out a share t of the unit multiplies the in-sample residual by 1 / (1 - t h), and

    .. math:: (1 - h)^{-1/2} = \frac{1}{\pi} \int_0^1 \frac{dt}{\sqrt{t (1 - t)}\,(1 - t h)} ,

    so the mean over the nodes of a Gauss-Chebyshev quadrature has the right variance, for every
    direction of the coefficients by itself. With three nodes it is right to 1 % up to h = 0.75 and
    at most 6: a unit that alone determines a coefficient says nothing of its own error, and must
    not dominate the sign flips.

    Returns:
        Shape (U, K).
    """
    gram, score, prior = sums.of(names)
    whole, right = gram.sum(0) + prior, score.sum(0)
    rights = [(right - share * score)[:, :, None] for share in LEFT_OUT]
    pairs = zip(LEFT_OUT, rights, strict=True)
    solved = [solve_positive(whole - share * gram, own)[..., 0] for share, own in pairs]
    return torch.stack(solved).mean(0)


def without_shares_of_each(values: Tensor) -> Tensor:
    """Sum up units (U, ...) without a share of each in turn, one fit a share and unit, (S, ...)."""
    shares = values.new_tensor(LEFT_OUT).reshape(-1, *[1] * values.ndim)
    return (values.sum(0) - shares * values).flatten(0, 1)


def mean_of_shares(coefficients: Tensor) -> Tensor:
    """Return the mean of each unit's fits, shape (U, ...), from all of them, (S, ...)."""
    return coefficients.unflatten(0, (len(LEFT_OUT), -1)).mean(0)


Fitted = Callable[[Tensor], Tensor]
"""Takes sums of all units, (U, ...), and returns those of the units of each of S fits, (S, ...)."""


def sums_over(kept: Tensor) -> Fitted:
    """Return what sums up the units that each of S fits keeps, shape (S, U)."""
    return partial(torch.tensordot, kept, dims=1)


class Reduced(NamedTuple):
    """The equations of one effect in S fits, beside the model.

    Attributes:
        across: Z, shape (S, K, E).
        normal: S, shape (S, E, E).
        right: s, shape (S, E).
    """

    across: Tensor
    normal: Tensor
    right: Tensor

    def solution(self) -> Tensor:
        """Return the coefficients of the effect, shape (S, E)."""
        return solve_positive(self.normal, self.right[:, :, None])[..., 0]

    def change(self, own: Tensor) -> Tensor:
        """Return how coefficients (S, E) of the effect change those of the model, shape (S, K)."""
        return -(self.across @ own[:, :, None])[..., 0]


class Elimination:
    """Fits of a model to all units but those that each of them leaves out.

    Args:
        sums: Of all units.
        chosen: Effects of the model.
        fitted: What each of the S fits is fitted to.

    Attributes:
        members: Numbers of the model's columns, shape (K,).
        rows: Products of the model's columns and all, for every unit, shape (U, K, P).
        normal: N_mm, shape (S, K, K).
        total_rows: Those rows and the prior, added up over all units, shape (K, P).
        solution: Coefficients of the model alone, shape (S, K).
    """

    def __init__(self, sums: Sums, chosen: Sequence[str], fitted: Fitted) -> None:
        self._sums, self._fitted = sums, fitted
        self.members = sums.layout.of(chosen)
        self.rows = sums.rows(chosen)
        prior = sums.layout.prior[self.members]
        self.total_rows = sums.total[self.members] + prior
        self._normal = self._fitted(self.rows) + prior
        self._right = self._fitted(sums.score)
        self.normal = self._normal[:, :, self.members]
        self._solve = solver(self.normal)
        self.solution = self._solve(self._right[:, self.members, None])[..., 0]
        self._inside = self.rows[:, :, self.members]

    def beside(self, name: str) -> Reduced:
        """Return the equations of one more effect."""
        own = slice(*self._sums.layout.effects[name])
        normal = self._fitted(self._sums.gram[:, own, own]) + self._sums.layout.prior[own, own]
        known, right = self._normal[:, :, own], self._right[:, self.members, None]
        across = self._solve(known)
        return Reduced(
            across=across,
            normal=normal - known.mT @ across,
            right=self._right[:, own] - (across.mT @ right)[..., 0],
        )

    def products(self, name: str, model: Tensor, own: Tensor) -> tuple[Tensor, Tensor]:
        """Return A_u times coefficients of the model (U, K, R) and of one more effect (U, E, R).

        Returns:
            The rows of the model, shape (U, K, R), and those of the effect, shape (U, E, R).
        """
        low, high = self._sums.layout.effects[name]
        across, gram = self.rows[:, :, low:high], self._sums.gram[:, low:high, low:high]
        return self._inside @ model + across @ own, across.mT @ model + gram @ own


@dataclass(frozen=True, kw_only=True)
class LinearSystem:
    """Columns of all candidates, the residual they may explain, and their sums.

    Attributes:
        columns: Of base model, effects and probes.
        pose: Columns of an uncertain pose, shape (M, 3).
        residual: Of the base fit less the maps already subtracted, shape (M,), metres.
        moments: Sums of products of these over the pixels of every pose.
        blocks: The same with the uncertainty of the poses included.
    """

    columns: Columns
    pose: Tensor
    residual: Tensor
    moments: Moments
    blocks: Blocks


def linear_system(
    observations: Observations,
    fit: BaseFit,
    inputs: EffectInputs,
    sources: Mapping[str, Callable[[EffectInputs], Tensor]],
) -> LinearSystem:
    """Compute all columns and sum them up.

    Args:
        observations: The pixels.
        fit: The base model, fitted.
        inputs: What effects may depend on.
        sources: What computes the columns of each effect and probe, metres at one prior standard
            deviation.
    """
    columns, layout = _columns(observations, fit, inputs, sources)
    pose = pose_columns(inputs)
    moments = gather_moments(observations, columns, pose, fit.residual, fit, layout)
    return LinearSystem(
        columns=columns,
        pose=pose,
        residual=fit.residual,
        moments=moments,
        blocks=with_pose_uncertainty(moments),
    )


def changed_system(
    system: LinearSystem,
    observations: Observations,
    fit: BaseFit,
    residual: Tensor,
    names: Sequence[str] = (),
    changed: Mapping[str, Tensor] | None = None,
) -> LinearSystem:
    """Return the system of another residual, and of other columns.

    Args:
        system: The system before.
        observations: The pixels.
        fit: Its noise and robust weights.
        residual: The new one, shape (M,), metres.
        names: Effects of the model whose residual the uncertainty of the poses is estimated from.
        changed: The columns of effects that differ, shape (M, E) each; None: all are the same.
    """
    changed = changed or {}
    columns = system.columns.with_changed(changed)
    moments = with_changed(
        system.moments, observations, columns, system.pose, residual, fit, changed
    )
    return replace(
        system,
        columns=columns,
        residual=residual,
        moments=moments,
        blocks=with_pose_uncertainty(moments, names),
    )


def _columns(
    observations: Observations,
    fit: BaseFit,
    inputs: EffectInputs,
    sources: Mapping[str, Callable[[EffectInputs], Tensor]],
) -> tuple[Columns, Layout]:
    """Return the columns of base model, effects and probes, and their layout."""
    uncertain = unknown_amplitude_columns(observations, inputs)
    if fit.known is not None:
        uncertain = torch.cat([fit.known.uncertain, uncertain], dim=1)
    num_units = observations.num_units
    # A strength weighs roughness against the mean square, so that it is multiplied by the sum of
    # the even weights: one a pose, each with a variance of EVEN_SD^2.
    prior = fit.model.prior_precision() + num_units / EVEN_SD**2 * fit.model.roughness()

    found = in_threads(lambda source: source(inputs), sources.values())
    effects = dict(zip(sources, found, strict=True))
    base = torch.cat([fit.model.columns(fit.tool_from_camera), uncertain], dim=1)
    columns = Columns(base=base, effects=effects)
    ones = torch.eye(uncertain.shape[1], dtype=torch.float64)
    return columns, columns.layout(torch.block_diag(prior, ones))
