"""The sums of each pose, with the uncertainty of the poses included.

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
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from tofcorr.diagnosis.sums.layout import Layout, blocks_between
from tofcorr.diagnosis.sums.moments import NUM_POSE, Moments
from tofcorr.diagnosis.sums.robust_weights import MAD_TO_SIGMA

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
