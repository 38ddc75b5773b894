r"""Scores of all poses under the null hypothesis, drawn once for all models.

With the columns X of a pose, those of its uncertain offset and tilts Z, and weights w, the products

.. math:: M = \begin{pmatrix} X' w X & X' w Z \\ Z' w X & Z' w Z \end{pmatrix}
    = \begin{pmatrix} W & C' \\ C & D \end{pmatrix}

are the covariance of the scores (x, z) of independent pixel noise. The likely sums, for the
dispersion f and the uncertainty S of the poses (see `blocks`), are
A = W / f - H C / f with H = C' / f (D / f + S^-1)^-1. Scores with that covariance are

.. math:: y = x / \sqrt f - H (z / \sqrt f + e), \quad e \sim N(0, S^{-1}) ,

so one draw of (x, z, e) serves every estimate of f and S. Draws have single precision: its rounding
is far below the ridge of `_factor`.
"""

from collections.abc import Iterator

import torch
from torch import Tensor

from tofcorr.diagnosis.sums.folds import Folds
from tofcorr.diagnosis.sums.moments import NUM_POSE, Moments

# Added to the covariance of a pose's scores, as a share of each variance: columns that one pose
# cannot distinguish leave it singular. Far above rounding, far below what a prior adds.
_RIDGE = 1e-11
# Numbers that are drawn at once, and that are kept, at most. Chosen: 16 MB and 200 MB; more than
# these are drawn again for every model.
_AT_ONCE = 4_000_000
_MOST_KEPT = 50_000_000


class ScoreDraws:
    """Draws of the scores of all poses, and of the poses' own offsets and tilts.

    Args:
        products: M of every pose, shape (U, P + 3, P + 3).
        folds: Of the poses.
        count: Number of draws B.
        seed: Of the draws.

    Attributes:
        products: See above.
        inside: Which poses each fold holds, shape (folds, U), float32.
        spans: The poses that are drawn together.
        errors: Draws of N(0, 1) for e, shape (U, 3, B), float32.
        pose: z, shape (U, 3, B), float32.
        of_folds: Sums of (x, z) over the poses of each fold, shape (folds, P + 3, B), float32.
    """

    def __init__(self, products: Tensor, folds: Folds, count: int, seed: int) -> None:
        self.products, self.inside = products, folds.members().float()
        units, size = products.shape[:2]
        step = max(1, _AT_ONCE // (size * count))
        self.spans = [slice(low, min(low + step, units)) for low in range(0, units, step)]
        generator = torch.Generator().manual_seed(seed)
        self.errors = torch.randn(units, NUM_POSE, count, generator=generator)
        self.pose = torch.empty_like(self.errors)
        self.of_folds = torch.zeros(folds.count, size, count)
        self._state = generator.get_state()
        self._kept: list[Tensor] | None = None
        kept: list[Tensor] | None = [] if units * size * count <= _MOST_KEPT else None
        for span, drawn in zip(self.spans, self.blocks(), strict=True):
            self.of_folds += torch.tensordot(self.inside[:, span], drawn, dims=1)
            self.pose[span] = drawn[:, -NUM_POSE:]
            if kept is not None:
                kept.append(drawn)
        self._kept = kept

    def blocks(self) -> Iterator[Tensor]:
        """Yield the draws (x, z) of the poses of each span, shape (U', P + 3, B), float32."""
        if self._kept is not None:
            yield from self._kept
            return
        generator = torch.Generator()
        generator.set_state(self._state)
        for span in self.spans:
            factor = _factor(self.products[span])
            yield factor @ torch.randn(len(factor), *self.of_folds.shape[1:], generator=generator)

    def added_up(self, factors: Tensor) -> Tensor:
        """Return sums of x times factors (U,) over each fold's poses, shape (folds, P, B)."""
        inside = self.inside * factors.float()
        total = torch.zeros_like(self.of_folds[:, :-NUM_POSE])
        for span, drawn in zip(self.spans, self.blocks(), strict=True):
            total += torch.tensordot(inside[:, span], drawn[:, :-NUM_POSE], dims=1)
        return total


class NullScores:
    """Draws from a normal distribution with the covariance A of the likely sums.

    Args:
        draws: For every estimate of the two others.
        pose_sd: Standard deviations of the poses' offset and tilts, shape (3,), metres.
        dispersion: The dispersion f.
    """

    def __init__(self, draws: ScoreDraws, pose_sd: Tensor, dispersion: float) -> None:
        cross = draws.products[:, -NUM_POSE:] / dispersion
        inner = cross[:, :, -NUM_POSE:] + torch.diag(pose_sd**-2)
        self._draws, self._scale, self._pose_sd = draws, dispersion**-0.5, pose_sd
        self._lift = -torch.linalg.solve(inner, cross[:, :, :-NUM_POSE]).mT.float()
        self._pose = draws.pose * self._scale + draws.errors / pose_sd.float()[:, None]

    @property
    def spans(self) -> list[slice]:
        """Which poses each of the `blocks` holds."""
        return self._draws.spans

    def of_folds(self) -> Tensor:
        """Return the sums of scores over the poses of each fold, shape (folds, P, B), float32."""
        total = self._scale * self._draws.of_folds[:, :-NUM_POSE]
        for fold, inside in zip(total, self._draws.inside, strict=True):
            own = inside.nonzero()[:, 0]
            lift, pose = self._lift[own], self._pose[own]
            fold.addmm_(lift.transpose(0, 1).flatten(1), pose.flatten(0, 1))
        return total

    def even_of_folds(self, moments: Moments, scale: float) -> Tensor:
        """Return the same draws as scores of even weights, shape (folds, P, B), float32.

        The errors of the poses are -S e. Within a pose, even weights are taken for those of the
        likely sums times a constant.

        Args:
            moments: Sums over the pixels.
            scale: What even sums are multiplied by.
        """
        first = moments.plain.shape[-1] - 1 - NUM_POSE
        ratio = moments.plain[:, first, first] / moments.weighted[:, first, first].clamp(min=1e-30)
        total = self._draws.added_up(scale / self._scale * ratio)
        across = scale * moments.plain[:, :first, first:-1].float()
        errors = -self._draws.errors * self._pose_sd.float()[:, None]
        for fold, inside in zip(total, self._draws.inside, strict=True):
            own = inside.nonzero()[:, 0]
            fold.addmm_(across[own].transpose(0, 1).flatten(1), errors[own].flatten(0, 1))
        return total

    def blocks(self) -> Iterator[Tensor]:
        """Yield the scores of the poses of each span, shape (U', P, B), float32."""
        for span, drawn in zip(self.spans, self._draws.blocks(), strict=True):
            yield torch.baddbmm(
                drawn[:, :-NUM_POSE], self._lift[span], self._pose[span], beta=self._scale
            )


def _factor(covariance: Tensor) -> Tensor:
    """Return F with F F' the covariance of each pose, shape (U, N, N), float32."""
    tiny = torch.finfo(torch.float64).tiny
    size = covariance.diagonal(dim1=1, dim2=2).clamp(min=tiny).sqrt()
    correlation = (covariance / size[:, :, None]).div_(size[:, None, :])
    correlation.diagonal(dim1=1, dim2=2).add_(_RIDGE)
    factor, failed = torch.linalg.cholesky_ex(correlation)
    if bool(failed.any()):
        values, vectors = torch.linalg.eigh(correlation)
        factor = vectors * values.clamp(min=0).sqrt()[:, None, :]
    return factor.float().mul_(size.float()[:, :, None])
