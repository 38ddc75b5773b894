"""The recording summed up pose by pose: small matrices from one pass over the pixels.

For the poses u (frames taken without moving belong together) and all columns X of base model and
effects, with residual y of the base fit, there are two kinds of sums

    A_u = X' W X,   b_u = X' W y.

*Even* sums weigh all pixels alike: what they fit best closes most millimetres, and they say how
many. *Likely* sums weigh by likelihood, W = V^-1 with

    V_u = f diag(sigma^2) + Z S Z',

where Z are the offset and two tilts by which the pose of camera or target is uncertain, drawn anew
for each pose with covariance S. The factor f says by how much the scores of poses scatter more
than independent noise of pixels lets them. They feel the smallest effects, and are what
significance is judged by; on real recordings, whose noise is correlated and whose model is never
complete, they are no measure of size. Every fold, subset of columns, bootstrap and sign flip is a
sum of such matrices.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from tofcorr.diagnosis.sums.moments import NUM_POSE, Layout, Moments

_MAD_TO_SIGMA = 1.4826
# The uncertainty of a pose never counts as less than this, metres: it keeps systems regular.
_LEAST_POSE_SD = 2e-5
_CERTAIN_SD = 1e-3
# In even sums a pose says as much as one value with this standard deviation, metres.
_EVEN_SD = 1e-3


@dataclass(frozen=True, kw_only=True)
class Sums:
    """One kind of sums over the pixels of every pose.

    Attributes:
        gram: A_u, shape (U, P, P).
        score: b_u, shape (U, P).
        layout: Where the columns stand.
    """

    gram: Tensor
    score: Tensor
    layout: Layout

    def of(self, names: Sequence[str]) -> tuple[Tensor, Tensor, Tensor]:
        """Return A_u, b_u and prior precision (K, K) of base model and some effects."""
        members = self.layout.of(names)
        prior = torch.diag(self.layout.prior[members])
        return self.gram[:, members[:, None], members], self.score[:, members], prior


@dataclass(frozen=True, kw_only=True)
class Blocks:
    """What each pose says.

    Attributes:
        even: Sums with even weights; a pose counts as one value with a standard deviation of 1 mm.
        likely: Sums weighted by likelihood.
        even_scale: What the even sums were multiplied by, 1 / m^2.
        square: Sum of squared residuals of the base fit with even weights, shape (U,), m^2.
        count: Sum of even weights, shape (U,).
        dispersion: The factor f.
        pose_sd: Standard deviations of offset and tilts, shape (3,), metres (tilts: at the edge of
            the image).
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
        """Where the columns stand."""
        return self.even.layout


def with_pose_uncertainty(moments: Moments, chosen: Sequence[str] = ()) -> Blocks:
    """Estimate how uncertain poses are and count it in.

    Args:
        moments: Sums over the pixels.
        chosen: Effects that belong to the model already.
    """
    certain = torch.full((NUM_POSE,), _CERTAIN_SD, dtype=torch.float64)
    dispersion = _dispersion(likely_sums(moments, certain, 1.0), chosen)
    scale = 1.0 / (float(moments.count.mean()) * _EVEN_SD**2)
    return blocks_of(moments, _pose_sd(moments, chosen, dispersion), dispersion, scale)


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
    weighted = moments.weighted / dispersion
    cross = weighted[:, first_z:last, :]
    inner = cross[:, :, first_z:last] + torch.diag(pose_sd**-2)
    reduced = weighted - cross.transpose(1, 2) @ torch.linalg.solve(inner, cross)
    return Sums(
        gram=reduced[:, :first_z, :first_z],
        score=reduced[:, :first_z, last],
        layout=moments.layout,
    )


def _dispersion(sums: Sums, chosen: Sequence[str]) -> float:
    """Compare the scatter of the poses' scores with what the pixels' noise allows.

    Every column outside the model gives one ratio; their median does not mind the few columns that
    an effect stands out in.
    """
    members = sums.layout.of(chosen)
    score = sums.score - sums.gram[:, :, members] @ solve(sums, chosen)
    outside = torch.ones(score.shape[1], dtype=torch.bool)
    outside[members] = False
    expected = sums.gram.diagonal(dim1=1, dim2=2).sum(0)
    outside &= expected > 0
    if not bool(outside.any()):
        return 1.0
    ratio = (score**2).sum(0)[outside] / expected[outside]
    return max(float(ratio.median()), 1.0)


def _pose_sd(moments: Moments, chosen: Sequence[str], dispersion: float) -> Tensor:
    """Estimate the standard deviations robustly from the poses' own offsets and tilts.

    They are taken from a fit that holds poses for certain to a millimetre. Estimating fit and
    uncertainty in turn can run away: looser poses leave the hand-eye transform free to drift, which
    makes poses look looser still.
    """
    last = moments.weighted.shape[-1] - 1
    z = slice(last - NUM_POSE, last)
    members = moments.layout.of(chosen)
    freedom = max(0.3, 1.0 - min(len(members), 12) / max(len(moments.count), 1))
    certain = torch.full((NUM_POSE,), _CERTAIN_SD, dtype=torch.float64)
    theta = solve(likely_sums(moments, certain, dispersion), chosen)
    cross = moments.weighted[:, z, :] / dispersion
    score = cross[:, :, last] - cross[:, :, members] @ theta
    inner = cross[:, :, z]
    enough = torch.linalg.matrix_rank(inner) == NUM_POSE
    if not bool(enough.any()):
        return certain
    own = torch.linalg.solve(inner[enough], score[enough])
    scatter = torch.linalg.inv(inner[enough]).diagonal(dim1=1, dim2=2)
    spread = (_MAD_TO_SIGMA * own.abs().median(dim=0).values) ** 2 / freedom
    return (spread - scatter.median(dim=0).values).clamp(min=_LEAST_POSE_SD**2).sqrt()


def solve(sums: Sums, names: Sequence[str]) -> Tensor:
    """Return the coefficients of base model and some effects, fitted to all poses, shape (K,)."""
    gram, score, prior = sums.of(names)
    return torch.linalg.solve(gram.sum(0) + prior, score.sum(0))
