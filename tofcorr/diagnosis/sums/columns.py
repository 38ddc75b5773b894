"""Which columns of a linear system belong to the base model and to each effect.

The columns of a linear system, each effect's in a matrix of its own.

Sums of products of all columns over the pixels of each pose or tile, from one pass.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from tofcorr.diagnosis.sums.base_fit import BaseFit
from tofcorr.diagnosis.sums.observations import Observations
from tofcorr.diagnosis.sums.resampling import Tiles
from tofcorr.pixels.threads import in_threads
from tofcorr.simulation.effects.inputs import EffectInputs


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

    def size(self, name: str) -> int:
        """Return the number of an effect's columns."""
        low, high = self.effects[name]
        return high - low

    def only(self, names: Sequence[str]) -> "Layout":
        """Return the layout of the columns `of(names)` alone."""
        places, start = {}, self.base
        for name in names:
            low, high = self.effects[name]
            places[name] = (start, start + high - low)
            start += high - low
        return Layout(base=self.base, effects=places, prior=self.prior_of(self.of(names)))

    def of(self, names: Sequence[str]) -> Tensor:
        """Return the numbers of the base model's columns, then those of some effects, int64."""
        return torch.cat([torch.arange(*span) for span in self.spans(names)])

    def spans(self, names: Sequence[str]) -> list[tuple[int, int]]:
        """Return first column and the one after the last, of the base model, then of effects."""
        return [(0, self.base), *(self.effects[name] for name in names)]

    def prior_of(self, members: Tensor) -> Tensor:
        """Return the prior precision of some columns (K,), shape (K, K)."""
        return self.prior[members][:, members]


def blocks_between(matrices: Tensor, spans: Sequence[tuple[int, int]]) -> Tensor:
    """Return the rows and columns of some spans, out of matrices (..., P, P).

    Whole spans are copied several times faster than columns chosen by their numbers.
    """
    rows = [
        torch.cat([matrices[..., low:high, slice(*span)] for span in spans], dim=-1)
        for low, high in spans
    ]
    return torch.cat(rows, dim=-2)


@dataclass(frozen=True, kw_only=True)
class Columns:
    """Columns over M pixels. They are never copied into one matrix of all pixels.

    Attributes:
        base: Of the base model, shape (M, K), metres per unit coefficient.
        effects: Of effects and probes, by name, shape (M, E) each, metres at one standard deviation
            of the prior.
    """

    base: Tensor
    effects: Mapping[str, Tensor]

    def of(self, names: Sequence[str]) -> list[Tensor]:
        """Return the columns of the base model and of some effects."""
        return [self.base, *(self.effects[name] for name in names)]

    def everything(self) -> list[Tensor]:
        """Return the columns of the base model and of all effects."""
        return self.of(list(self.effects))

    def layout(self, prior: Tensor) -> Layout:
        """Return which columns belong to what.

        Args:
            prior: Prior precision of the base model, shape (K, K).
        """
        places, start = {}, self.base.shape[1]
        for name, own in self.effects.items():
            places[name] = (start, start + own.shape[1])
            start += own.shape[1]
        ones = torch.eye(start - self.base.shape[1], dtype=torch.float64)
        return Layout(base=self.base.shape[1], effects=places, prior=torch.block_diag(prior, ones))

    def times(self, names: Sequence[str], coefficients: Tensor) -> Tensor:
        """Return what base model and some effects predict with coefficients (K,), (M,), metres."""
        parts = self.of(names)
        own = coefficients.split([part.shape[1] for part in parts])
        total = parts[0] @ own[0]
        for part, theta in zip(parts[1:], own[1:], strict=True):
            total.addmv_(part, theta)
        return total

    def where(self, used: Tensor) -> "Columns":
        """Return the columns with zeros in the pixels that are not used; bool of shape (M,)."""
        return Columns(
            base=torch.where(used[:, None], self.base, 0.0),
            effects={name: torch.where(used[:, None], x, 0.0) for name, x in self.effects.items()},
        )

    def with_changed(self, changed: Mapping[str, Tensor]) -> "Columns":
        """Return the columns with others for some effects."""
        return replace(self, effects={**self.effects, **changed})


NUM_POSE = 3
"""Columns of an uncertain pose: an offset and two tilts."""
# Added to the diagonal of a pose's products, as a share of its mean, so that they are regular where
# few of its pixels count. Chosen, far above the rounding of float64.
_TILE_RIDGE = 1e-9
# Where a tilt is measured, metres from the centre. Chosen: half of what a camera sees at one metre.
_ARM = 0.3


@dataclass(frozen=True, kw_only=True)
class Moments:
    """Sums over the pixels of every pose, without the uncertainty of the poses.

    Attributes:
        weighted: Inner products of the columns, the pose columns and the residual, weighted by
            1 / sigma^2, shape (U, P + 4, P + 4).
        plain: The same with the weights of the gap in millimetres, `BaseFit.share`.
        count: Sum of the plain weights, shape (U,).
        layout: Which columns belong to what.
        tiled: The largest sums over tiles that were computed before, if any were.
    """

    weighted: Tensor
    plain: Tensor
    count: Tensor
    layout: Layout
    tiled: "list[Moments]" = field(default_factory=list, init=False, repr=False)

    def of(self, names: Sequence[str]) -> "Moments":
        """Return the sums of base model and some effects, the pose columns and the residual."""
        size = self.plain.shape[-1]
        spans = [*self.layout.spans(names), (size - NUM_POSE - 1, size)]
        return Moments(
            weighted=blocks_between(self.weighted, spans),
            plain=blocks_between(self.plain, spans),
            count=self.count,
            layout=self.layout.only(names),
        )


def pose_columns(inputs: EffectInputs) -> Tensor:
    r"""Return the change of the distance with the offset and two tilts of a pose, shape (M, 3).

    The distance of a target whose plane moves by a along its normal and turns by the small angles b
    and c changes by

    .. math:: \Delta D = \frac{a + b\,x + c\,y}{\cos\theta} ,

    with x and y in the plane, from the mean of the frame's pixels. A tilt is measured by the change
    `_ARM` away from there, metres.
    """
    place = inputs.target_xy
    known = place.isfinite().all(1)
    frames = len(inputs.facts.offset)
    total = place.new_zeros(frames, 2).index_add(0, inputs.frame[known], place[known])
    count = torch.bincount(inputs.frame[known], minlength=frames).clamp(min=1)
    aside = (place - (total / count[:, None])[inputs.frame]) / _ARM
    ones = torch.ones_like(aside[:, :1])
    return torch.cat([ones, aside], dim=1) / inputs.incidence_cosine[:, None]


def gather_moments(
    observations: Observations,
    columns: Columns,
    pose: Tensor,
    residual: Tensor,
    fit: BaseFit,
    layout: Layout,
) -> Moments:
    """Sum up products of all columns over the pixels of each pose.

    Args:
        observations: The pixels.
        columns: Of base model and effects.
        pose: Columns of `pose_columns`, shape (M, 3).
        residual: Of the base fit, shape (M,), metres.
        fit: Its noise and robust weights.
        layout: Which columns belong to what.
    """
    parts = [*columns.everything(), pose, residual[:, None]]
    weights = fit.trust / fit.sigma**2, fit.share
    size = sum(part.shape[1] for part in parts)
    weighted, plain = (
        torch.zeros(observations.num_units, size, size, dtype=torch.float64) for _ in weights
    )
    count = torch.zeros(observations.num_units, dtype=torch.float64)
    frames_of: list[list[tuple[int, int]]] = [[] for _ in count]
    for unit, ends in zip(observations.unit.tolist(), observations.frame_ends, strict=True):
        frames_of[unit].append(ends)

    def sum_pose(unit: int) -> None:
        for start, end in frames_of[unit]:
            everything = torch.cat([part[start:end] for part in parts], dim=1)
            for sums, weight in zip((weighted, plain), weights, strict=True):
                root = (everything * weight[start:end, None].sqrt()).numpy()
                # NumPy sees a matrix times itself, and computes half of the products: that takes
                # half of the time of torch's.
                sums[unit] += torch.from_numpy(root.T @ root)
            count[unit] += fit.share[start:end].sum()

    for _ in in_threads(sum_pose, range(observations.num_units)):
        pass
    return Moments(weighted=weighted, plain=plain, count=count, layout=layout)


def tile_moments(
    moments: Moments,
    names: Sequence[str],
    tiles: Tiles,
    columns: Columns,
    pose: Tensor,
    residual: Tensor,
    fit: BaseFit,
) -> Moments:
    """Return the sums of base model and some effects over whole poses and tiles of others.

    Tiles flip on their own. What the uncertainty of their pose gives all of them is therefore taken
    off the weighted sums first: the offset and two tilts fitted to the whole pose. The sums are
    kept, and grow by what is asked for: models that are compared share most of their effects.

    Args:
        moments: The sums over poses; those of whole poses are taken from here.
        names: The effects.
        tiles: The units.
        columns: Of everything in `moments`.
        pose: Columns of `pose_columns`, shape (M, 3).
        residual: Of the base fit, shape (M,), metres.
        fit: Its noise and robust weights.
    """
    known = moments.tiled[0] if moments.tiled else None
    before = [] if known is None else list(known.layout.effects)
    everything = list(dict.fromkeys([*before, *names]))
    if known is None or len(everything) > len(before):
        parts = [*columns.of(everything), pose, residual[:, None]]
        known = _sum_tiles(moments.of(everything), tiles, parts, fit)
        moments.tiled[:] = [known]
    return known.of(names)


def _sum_tiles(whole: Moments, tiles: Tiles, parts: Sequence[Tensor], fit: BaseFit) -> Moments:
    """Return the sums over whole poses, which are known, and over the tiles of others."""
    cut = tiles.pixels
    everything = torch.cat([part[cut] for part in parts], dim=1)
    weights = (fit.trust / fit.sigma**2)[cut], fit.share[cut]
    right = torch.cat([everything * own[:, None] for own in weights], dim=1)
    pairs = zip(everything.split(tiles.counts), right.split(tiles.counts), strict=True)
    weighted, plain = torch.stack([x.T @ y for x, y in pairs]).chunk(2, dim=2)
    weighted = _without_pose(weighted, tiles.pose[len(tiles.whole) :])
    count = torch.stack([own.sum() for own in weights[1].split(tiles.counts)])
    return Moments(
        weighted=torch.cat([whole.weighted[tiles.whole], weighted]),
        plain=torch.cat([whole.plain[tiles.whole], plain]),
        count=torch.cat([whole.count[tiles.whole], count]),
        layout=whole.layout,
    )


def _without_pose(sums: Tensor, pose: Tensor) -> Tensor:
    """Take each pose's offset and tilts off all columns but those of the pose itself.

    Args:
        sums: Products of the columns of the model, of the pose, and the residual, over each tile,
            shape (T, K + 4, K + 4).
        pose: Pose of every tile, shape (T,), int64.
    """
    last = sums.shape[-1] - 1
    own = slice(last - NUM_POSE, last)
    poses, number = pose.unique(return_inverse=True)
    whole = sums.new_zeros(len(poses), *sums.shape[1:]).index_add(0, number, sums)
    normal = whole[:, own, own]
    ridge = _TILE_RIDGE * normal.diagonal(dim1=1, dim2=2).mean(1)
    normal = normal + ridge[:, None, None] * torch.eye(NUM_POSE, dtype=torch.float64)
    fitted = torch.linalg.solve(normal, whole[:, own])
    fitted[:, :, own] = 0.0
    # With the columns X, those of the pose Z and the fit F: sums of products of X - Z F.
    fitted, cross = fitted[number], sums[:, own]
    change = fitted.mT @ (cross - cross[:, :, own] @ fitted / 2)
    return sums - change - change.mT


def with_changed(
    moments: Moments,
    observations: Observations,
    columns: Columns,
    pose: Tensor,
    residual: Tensor,
    fit: BaseFit,
    changed: Collection[str] = (),
) -> Moments:
    """Return the moments of another residual (M,), and of effects whose columns have changed.

    Args:
        moments: Those before; products of unchanged columns are taken from here.
        observations: The pixels.
        columns: Of base model and effects, the changed ones included.
        pose: Columns of `pose_columns`, shape (M, 3).
        residual: Shape (M,), metres.
        fit: Its noise and robust weights.
        changed: Effects whose columns have changed.
    """
    last = moments.plain.shape[-1] - 1
    spans = [moments.layout.effects[name] for name in changed]
    places = torch.cat([torch.arange(*span) for span in (*spans, (last, last + 1))])
    new = torch.cat([*(columns.effects[name] for name in changed), residual[:, None]], dim=1)
    weights = fit.trust / fit.sigma**2, fit.share
    # One pass over the columns gives both sums.
    right = torch.cat([own[:, None] * new for own in weights], dim=1)
    parts = [*columns.everything(), pose, residual[:, None]]
    products = torch.cat([observations.products(part, right) for part in parts], dim=1)
    weighted, plain = moments.weighted.clone(), moments.plain.clone()
    for sums, own in zip((weighted, plain), products.chunk(2, dim=-1), strict=True):
        sums[:, :, places] = own
        sums[:, places, :] = own.mT
    return replace(moments, weighted=weighted, plain=plain)
