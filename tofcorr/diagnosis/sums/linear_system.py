r"""Columns over the pixels of a recording, and the normal equations of every pose.

For the poses u (frames taken without moving belong together) and all columns X of base model and
effects, with residual y of the base fit, there are two kinds of sums

    A_u = X' W X,   b_u = X' W y.

*Ordinary* least squares (`ols`) weighs all pixels alike. Its fit has the smallest residual in
millimetres, so sizes are computed from it. *Generalised* least squares (`gls`) weighs by
likelihood, W = V^-1 with

    V_u = f diag(sigma^2) + Z S Z',

where Z holds the offset and two tilts by which the pose of camera or target is uncertain,
independent for each pose, with covariance S. The dispersion f is the variance of the poses' scores
over the variance that independent pixel noise would give. It detects the smallest effects, so
significance is computed from it. It does not measure size: real noise is correlated, and no model
is complete. Every fold, subset of columns, bootstrap and sign flip is a sum of such matrices.

Poses are the units of every test, because one disturbance affects a whole image.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import accumulate, pairwise

import torch
from numpy.polynomial.chebyshev import chebgauss
from torch import Tensor

from tofcorr.diagnosis.sums.base import BaseFit
from tofcorr.diagnosis.sums.observations import Observations
from tofcorr.estimation.robust import sigma_from_mad
from tofcorr.pixels.dataset import in_threads
from tofcorr.simulation.effects.base import EffectInputs

BASE = "base"
"""The name of the base model among the columns."""
OLS_SD = 1e-3
"""Ordinary sums weigh a mean pose as one value with this standard deviation, metres; the same holds
for offset and tilts in the fit that their uncertainty is estimated from. Chosen: 1 mm."""


@dataclass(frozen=True, kw_only=True)
class Layout:
    """Which columns belong to the base model and to each effect.

    Attributes:
        base: Number of columns of the base model; they come first. What is uncertain of the
            simulator's own error, or stands in for an amplitude that was not recorded, follows the
            terms and counts as part of the base model.
        effects: First column of every effect, and the one after its last.
        prior: Prior precision of all coefficients, shape (P, P). The columns of effects are scaled
            to a prior standard deviation of one.
    """

    base: int
    effects: dict[str, tuple[int, int]]
    prior: Tensor

    def only(self, names: Sequence[str]) -> "Layout":
        """Return the layout of the columns `of(names)` alone."""
        ends = accumulate((high - low for low, high in self.spans(names)), initial=0)
        places = dict(zip((BASE, *names), pairwise(ends), strict=True))
        return Layout(base=places.pop(BASE)[1], effects=places, prior=self.prior_of(self.of(names)))

    def of(self, names: Sequence[str]) -> Tensor:
        """Return the numbers of the base model's columns, then those of some effects, int64."""
        return torch.cat([torch.arange(*span) for span in self.spans(names)])

    def spans(self, names: Sequence[str]) -> list[tuple[int, int]]:
        """Return first column and the one after the last, of the base model, then of effects."""
        return [(0, self.base), *(self.effects[name] for name in names)]

    def prior_of(self, members: Tensor) -> Tensor:
        """Return the prior precision of some columns (K,), shape (K, K)."""
        return self.prior[members][:, members]


def _between(matrices: Tensor, spans: Sequence[tuple[int, int]]) -> Tensor:
    """Return the rows and columns of some spans, out of matrices (..., P, P).

    Whole spans are copied several times faster than columns chosen by their numbers.
    """
    columns = torch.cat([matrices[..., slice(*span)] for span in spans], dim=-1)
    return torch.cat([columns[..., slice(*span), :] for span in spans], dim=-2)


@dataclass(frozen=True, kw_only=True)
class Sums:
    """Normal equations of every unit, a pose or a tile, with one kind of weights.

    Attributes:
        gram: A_u, shape (U, P, P).
        score: b_u, shape (U, P).
        square: y' W y over the scale, shape (U,); m^2 with ordinary weights.
        scale: What A_u and b_u were multiplied by; 1 / m^2 with ordinary weights.
        layout: Which columns belong to what.
    """

    gram: Tensor
    score: Tensor
    square: Tensor
    scale: float
    layout: Layout

    @cached_property
    def total(self) -> Tensor:
        """Sum of A_u over all units, shape (P, P)."""
        return self.gram.sum(0)

    def of(self, names: Sequence[str]) -> tuple[Tensor, Tensor, Tensor]:
        """Return A_u, b_u and prior precision (K, K) of base model and some effects."""
        spans = self.layout.spans(names)
        score = torch.cat([self.score[:, slice(*span)] for span in spans], dim=1)
        return _between(self.gram, spans), score, self.layout.prior_of(self.layout.of(names))

    def normal(self, names: Sequence[str]) -> Tensor:
        """Return the normal matrix of base model and some effects over all units, (K, K)."""
        members = self.layout.of(names)
        return self.total[members][:, members] + self.layout.prior_of(members)

    def solve(self, names: Sequence[str]) -> Tensor:
        """Return the coefficients of base model and some effects, fitted to all units, (K,)."""
        return torch.linalg.solve(self.normal(names), self.score[:, self.layout.of(names)].sum(0))

    def squares_at(self, names: Sequence[str], coefficients: Tensor) -> Tensor:
        """Return the sum of squares of each unit at coefficients (U, K) of its own, (U,), m^2."""
        gram, score, _ = self.of(names)
        curved = (gram @ coefficients[:, :, None])[..., 0]
        return self.square - (coefficients * (2 * score - curved)).sum(1) / self.scale

    def left_out_coefficients(self, names: Sequence[str], *shares: float) -> Tensor:
        """Return for every unit the coefficients that all others give, shape (U, K).

        Args:
            names: The effects.
            shares: What is left out of the unit, in one fit each; their mean is returned.
        """
        gram, score, prior = self.of(names)
        whole, right = gram.sum(0) + prior, score.sum(0)
        fits = [torch.linalg.solve(whole - t * gram, right - t * score) for t in shares or (1.0,)]
        return torch.stack(fits).mean(0)

    def left_out_solutions(self, names: Sequence[str]) -> Tensor:
        r"""Return for every unit the coefficients that give its residual the variance of its error.

        A unit of leverage h has an in-sample residual that is too small by sqrt(1 - h), and a
        leave-one-out residual that is too large by 1 / sqrt(1 - h) (Bell and McCaffrey 2002).
        Leaving out a share t of the unit multiplies the in-sample residual by 1 / (1 - t h), and

        .. math:: (1 - h)^{-1/2} = \frac{1}{\pi} \int_0^1 \frac{dt}{\sqrt{t (1 - t)}\,(1 - t h)} ,

        so the mean over the nodes of a Gauss-Chebyshev quadrature has the right variance, for every
        direction of the coefficients by itself. With three nodes it is right to 1 % up to h = 0.75
        and at most 6: a unit that alone determines a coefficient says nothing of its own error, and
        must not dominate the sign flips.

        Returns:
            Shape (U, K).
        """
        nodes, _ = chebgauss(3)
        return self.left_out_coefficients(names, *(1 + nodes) / 2)


@dataclass(frozen=True, kw_only=True)
class PoseSums:
    """Products of all columns over the pixels of every pose, and how uncertain poses are.

    Attributes:
        weighted: Inner products of the columns, the pose columns and the residual, weighted by
            1 / sigma^2, shape (U, P + 4, P + 4).
        plain: The same with the weights of the gap in millimetres, `BaseFit.share`.
        count: Sum of the plain weights, shape (U,).
        layout: Which columns belong to what.
        scale: What ordinary sums are multiplied by, 1 / m^2.
        dispersion: The dispersion f, at least 1.
        pose_sd: Standard deviations of offset and tilts, shape (3,), metres (tilts: 0.3 m from the
            centre of what a frame shows).
    """

    weighted: Tensor
    plain: Tensor
    count: Tensor
    layout: Layout
    scale: float
    dispersion: float
    pose_sd: Tensor

    @property
    def num_units(self) -> int:
        """Number of poses."""
        return len(self.count)

    @property
    def num_columns(self) -> int:
        """Number of columns P of base model and effects; those of the pose follow."""
        return self.plain.shape[-1] - len(self.pose_sd) - 1

    @cached_property
    def ols(self) -> Sums:
        """Ordinary least squares: a pose weighs as much as one value known to 1 mm."""
        return self._equations(self.scale * self.plain, self.scale)

    @cached_property
    def gls(self) -> Sums:
        """Generalised least squares: weighted by likelihood, with the uncertainty of the poses."""
        share, pose = 1 / self.dispersion, slice(self.num_columns, -1)
        cross = share * self.weighted[:, pose]
        solved = torch.linalg.solve(cross[:, :, pose] + torch.diag(self.pose_sd**-2), cross)
        left = torch.baddbmm(self.weighted, cross.mT, solved, beta=share, alpha=-1)
        return self._equations(left, 1.0)

    def _equations(self, products: Tensor, scale: float) -> Sums:
        count = self.num_columns
        return Sums(
            gram=products[:, :count, :count],
            score=products[:, :count, -1],
            square=products[:, -1, -1] / scale,
            scale=scale,
            layout=self.layout,
        )

    def of(self, names: Sequence[str]) -> "PoseSums":
        """Return the sums of base model and some effects, the pose columns and the residual."""
        spans = [*self.layout.spans(names), (self.num_columns, self.plain.shape[-1])]
        weighted, plain = _between(self.weighted, spans), _between(self.plain, spans)
        return replace(self, weighted=weighted, plain=plain, layout=self.layout.only(names))

    def with_pose_uncertainty(self, chosen: Sequence[str] = ()) -> "PoseSums":
        """Return the sums with the uncertainty of the poses estimated beside some effects."""
        assumed = torch.full_like(self.pose_sd, OLS_SD)
        start = replace(self, dispersion=1.0, pose_sd=assumed)
        dispersion = _dispersion(start.gls, chosen)
        pose_sd = _pose_sd(replace(start.of(chosen), dispersion=dispersion), chosen)
        return replace(self, dispersion=dispersion, pose_sd=pose_sd)


def _dispersion(gls: Sums, chosen: Sequence[str]) -> float:
    """Return the variance of the poses' scores over that which pixel noise gives, at least 1.

    Every column outside the model gives one ratio. Their median is insensitive to the few columns
    in which a missing effect shows.
    """
    members = gls.layout.of(chosen)
    left = gls.score - gls.solve(chosen) @ gls.gram[:, members]
    total = gls.gram.diagonal(dim1=1, dim2=2).sum(0)
    outside = total > 0
    outside[members] = False
    if not bool(outside.any()):
        return 1.0
    return max(float(((left**2).sum(0)[outside] / total[outside]).median()), 1.0)


def _pose_sd(sums: PoseSums, chosen: Sequence[str]) -> Tensor:
    """Estimate the standard deviations robustly from the poses' own offsets and tilts.

    The fit assumes poses known to a millimetre. Estimating fit and uncertainty in turn can diverge:
    less certain poses let the hand-eye transform drift, and then look less certain still.

    Args:
        sums: Of the model alone, with the poses' assumed uncertainty.
        chosen: Effects of the model.
    """
    count, pose = sums.num_columns, slice(sums.num_columns, -1)
    cross = sums.weighted[:, pose] / sums.dispersion
    score = cross[:, :, -1] - cross[:, :, :count] @ sums.gls.solve(chosen)
    inner = cross[:, :, pose]
    enough = torch.linalg.matrix_rank(inner) == len(sums.pose_sd)
    if not bool(enough.any()):
        return sums.pose_sd
    own = torch.linalg.solve(inner[enough], score[enough])
    noise = torch.linalg.inv(inner[enough]).diagonal(dim1=1, dim2=2)
    # At most twelve coefficients count as determined by the poses' own offsets, and a share of the
    # degrees of freedom as unused: both bound the correction for recordings of few poses. Poses are
    # never better known than robots repeat, by far; that keeps systems regular.
    freedom = max(0.3, 1.0 - min(count, 12) / sums.num_units)
    spread = sigma_from_mad(own.abs().median(dim=0).values) ** 2 / freedom
    return (spread - noise.median(dim=0).values).clamp(min=2e-5**2).sqrt()


def pose_columns(inputs: EffectInputs, *, arm: float = 0.3) -> Tensor:
    r"""Return the change of the distance with the offset and two tilts of a pose, shape (M, 3).

    The distance of a target whose plane moves by a along its normal and turns by the small angles b
    and c changes by

    .. math:: \Delta D = \frac{a + b\,x + c\,y}{\cos\theta} ,

    with x and y in the plane, from the mean of the frame's pixels. A tilt is measured by the change
    `arm` away from there, metres.

    Args:
        inputs: What effects may depend on.
        arm: Where a tilt is measured, metres from the centre. Chosen: half of what a camera sees at
            one metre.
    """
    place = inputs.target_xy
    known = place.isfinite().all(1)
    frames = len(inputs.facts.offset)
    total = place.new_zeros(frames, 2).index_add(0, inputs.frame[known], place[known])
    count = torch.bincount(inputs.frame[known], minlength=frames).clamp(min=1)
    aside = (place - (total / count[:, None])[inputs.frame]) / arm
    ones = torch.ones_like(aside[:, :1])
    return torch.cat([ones, aside], dim=1) / inputs.incidence_cosine[:, None]


def pose_sums(
    observations: Observations,
    columns: Mapping[str, Tensor],
    pose: Tensor,
    fit: BaseFit,
    prior: Tensor,
) -> PoseSums:
    """Sum up products of all columns over the pixels of each pose.

    Args:
        observations: The pixels.
        columns: Of base model and effects by name, as in `Study`, shape (M, K) each.
        pose: Columns of `pose_columns`, shape (M, 3).
        fit: Residual, noise and robust weights.
        prior: Prior precision of the base model, shape (K, K).
    """
    ends = list(accumulate((own.shape[1] for own in columns.values()), initial=0))
    spans = dict(zip(columns, pairwise(ends), strict=True))
    del spans[BASE]
    ones = torch.eye(ends[-1] - len(prior), dtype=torch.float64)
    layout = Layout(base=len(prior), effects=spans, prior=torch.block_diag(prior, ones))
    parts = [*columns.values(), pose, fit.residual[:, None]]
    unit = observations.unit[observations.frame]
    sizes = torch.bincount(unit, minlength=observations.num_units)  # A pose may have no pixel.
    pixels = unit.argsort(stable=True).split(sizes.tolist())
    roots = [weight.sqrt()[:, None] for weight in (fit.weight, fit.share)]

    def of_unit(own: Tensor) -> tuple[Tensor, ...]:
        everything = torch.cat([part[own] for part in parts], dim=1)
        # NumPy sees a matrix times itself, and computes half of the products: that takes half of
        # the time of torch's.
        scaled = [(everything * root[own]).numpy() for root in roots]
        return *(torch.from_numpy(one.T @ one) for one in scaled), fit.share[own].sum()

    weighted, plain, count = map(torch.stack, zip(*in_threads(of_unit, pixels), strict=True))
    return PoseSums(
        weighted=weighted,
        plain=plain,
        count=count,
        layout=layout,
        scale=1.0 / (float(count.mean()) * OLS_SD**2),
        dispersion=1.0,
        pose_sd=torch.full((pose.shape[1],), OLS_SD, dtype=torch.float64),
    )


def draw_folds(num_units: int, count: int, generator: torch.Generator) -> Tensor:
    """Assign units at random to folds of equal size; no more folds than units.

    Returns:
        Which units each fold holds out, shape (folds, U), float64.
    """
    count = min(count, num_units)
    order = torch.randperm(num_units, generator=generator)
    of_unit = (torch.arange(num_units) % count)[order.argsort()]
    return (of_unit == torch.arange(count)[:, None]).double()
