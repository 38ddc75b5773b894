"""Finds where simulator and recording differ: along which covariates, where in the image.

For every bin b of a covariate and every pose u, S_ub is the weighted sum of the residuals, each
pose left out of its own fit. The statistic |sum_u S_ub| / sqrt(sum_u S_ub^2) is compared with its
maximum over all bins of all covariates when whole poses flip their sign. So is the slope of a line
along each covariate. This is done for the gap in three stages: the simulator as given,
recalibrated, and with the effects named.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from tofcorr.conditions import OPTIONAL_CONDITIONS, condition
from tofcorr.diagnosis.findings.effect_comparison import left_out_residual
from tofcorr.diagnosis.findings.gap import Gap, Interval
from tofcorr.diagnosis.findings.naming import NamedEffects
from tofcorr.diagnosis.sums.observations import TINY
from tofcorr.diagnosis.sums.study import Study
from tofcorr.simulation.effects.inputs import is_clock

# Bins of a covariate, and values of it that are looked at first. Chosen: few enough bins that each
# holds many poses; of most covariates the first values already tell that there are many levels.
_BINS, _FEW = 8, 1000
# Rows and columns of tiles in the image, and the number of poses that a bin needs for a test.
# Chosen: few enough that each bin holds many poses.
_TILES = (6, 8)
_LEAST_UNITS = 4
# Pixels that tell how much of a sum a fit takes, at most, evenly spread. Chosen: a sum over a tenth
# of them is known to 2 %.
_MOST_PIXELS = 20_000
# Least standard deviation of a sum that the model was fitted to, over that of residuals that it was
# not. Chosen: what the model absorbs so far shows no bias, and how far is known to 2 %.
_LEAST_LEFT = 0.1
# Relative difference of two statistics that counts as none. A bin of few poses has flips that give
# what was observed; rounding, some 1e-15, must not decide about them. Chosen.
_ROUNDING = 1e-9


@dataclass(frozen=True, kw_only=True)
class Region:
    """A bin of a covariate.

    Attributes:
        covariate: Its name.
        low, high: Its ends, in the unit of the covariate.
        bias: Mean residual, metres.
        interval: 95 %, simultaneous over all regions.
        p_value: Adjusted for the number of regions.
        trend: Whether this is the change along the whole covariate, fitted by a line, not one bin.
    """

    covariate: str
    low: float
    high: float
    bias: float
    interval: tuple[float, float]
    p_value: float
    trend: bool = False


@dataclass(frozen=True, kw_only=True)
class Where:
    """The bias along all covariates, and over the image.

    Attributes:
        regions: Bins and trends of covariates, the most significant first.
        tiles: Bias of each tile of the image, shape (rows, columns), metres.
        tile_p_values: Their adjusted p-values, shape (rows, columns).
        offsets: Mean residual of each pose, shape (U,), metres.
    """

    regions: tuple[Region, ...]
    tiles: np.ndarray
    tile_p_values: np.ndarray
    offsets: np.ndarray

    def by_covariate(self) -> dict[str, list[Region]]:
        """Return the bins of each covariate in order; the most significant covariate is first."""
        groups: dict[str, list[Region]] = {}
        for region in self.regions:
            groups.setdefault(region.covariate, []).append(region)
        for bins in groups.values():
            bins.sort(key=lambda region: (region.trend, region.low))
        return groups


Binned = tuple[str, tuple[float, ...], Tensor, Tensor]
"""Name of a covariate; edges of its bins, in its unit; bin of every pixel, shape (M,), int64; and
the covariate scaled to a range from 0 to 1, shape (M,)."""


def binned_covariates(study: Study) -> list[Binned]:
    """Return the covariates that have more than one value, in bins."""
    binned: list[Binned] = []
    for name, values in covariates(study).items():
        edges = _edges(values)
        if len(edges) < 3:
            continue
        place = torch.bucketize(values.contiguous(), torch.from_numpy(edges[1:-1]), right=True)
        span = (values.max() - values.min()).clamp(min=TINY)
        binned.append((name, tuple(edges.tolist()), place, (values - values.min()) / span))
    return binned


def covariates(study: Study) -> dict[str, Tensor]:
    """Return what a bias may depend on, for each pixel, by name; units as in the recording."""
    inputs, facts = study.inputs, study.inputs.facts
    camera = inputs.camera
    found = {
        "distance_m": inputs.radial_distance,
        "row": (inputs.rows + 1) / 2 * (camera.height - 1),
        "column": (inputs.columns + 1) / 2 * (camera.width - 1),
        "image_radius": (inputs.rows**2 + inputs.columns**2).sqrt(),
        "incidence_deg": torch.rad2deg(torch.acos(inputs.incidence_cosine.clamp(-1.0, 1.0))),
    }
    if inputs.amplitude is not None:
        found["amplitude"] = inputs.amplitude
    if inputs.modulation_frequency is not None:
        found["phase_quarter_deg"] = torch.rad2deg(torch.remainder(4 * inputs.phase, 2 * torch.pi))
    found |= _of_frames(study)
    if study.observations.recording.moves:
        found["target_x_m"], found["target_y_m"] = inputs.target_xy.unbind(1)
        place = inputs.of_frame(facts.world_from_tool[:, :3, 3])
        found["tool_x_m"], found["tool_y_m"], found["tool_z_m"] = place.unbind(1)
    return {name: values for name, values in found.items() if bool(values.isfinite().all())}


def _of_frames(study: Study) -> dict[str, Tensor]:
    inputs, facts = study.inputs, study.inputs.facts
    known = {}
    if is_clock(facts.timestamp):
        known[condition("timestamp").covariate] = facts.timestamp
    for each in OPTIONAL_CONDITIONS:
        values = getattr(facts, each.name)
        if values is not None:
            known[each.covariate] = each.in_file(values)
    known["frame"] = torch.arange(len(facts.timestamp)).double()
    return {name: inputs.of_frame(values) for name, values in known.items()}


def _edges(values: Tensor) -> np.ndarray:
    """Return edges of bins with equally many pixels; a covariate of few levels gets a bin each."""
    levels = np.unique(values[:_FEW].numpy())
    if len(levels) <= _BINS:
        levels = np.unique(values.numpy())
    if len(levels) > _BINS:
        return np.unique(np.quantile(values.numpy(), np.linspace(0, 1, _BINS + 1)))
    if len(levels) < 2:
        return levels
    return np.concatenate([levels[:1], (levels[:-1] + levels[1:]) / 2, levels[-1:]])


class Flips:
    """Sums of residuals, observed and when whole poses flip their sign.

    Flipped residuals of a fit are no residuals: a fit would take part of them away, as it did of
    the observed ones. Compared with them as they are, biases that the model absorbs hide those that
    it does not. So the model is fitted to them again.

    Args:
        study: The recording.
        residual: Shape (M,), metres.
        chosen: Effects of the model that was fitted; None: the residual is of no fit.
    """

    def __init__(self, study: Study, residual: Tensor, chosen: Sequence[str] | None = None) -> None:
        # The first column is the observed residual.
        self._signs = torch.cat([torch.ones_like(study.signs[:1]), study.signs]).T
        self._step = max(1, len(residual) // _MOST_PIXELS)
        self._theta = None
        if chosen is None:
            return
        columns, ols = study.system.of(chosen), study.sums.ols
        weighted = (ols.scale * study.fit.share * residual)[:, None]
        scores = [study.observations.products(own, weighted)[..., 0] for own in columns]
        right = torch.cat(scores, dim=1).T @ self._signs
        self._theta = torch.linalg.solve(ols.normal(chosen), right)
        weight = self._step * study.weight[:: self._step, None]
        self._weighted = weight * torch.cat([own[:: self._step] for own in columns], dim=1)

    def of(self, sums: Tensor, place: Tensor, along: Tensor) -> Tensor:
        """Return sums over bins, observed and of every flip, shape (bins, 1 + B).

        Args:
            sums: Weighted residuals of every bin and pose, shape (bins, U).
            place: Bin of each pixel, shape (M,), int64.
            along: What the residual of each pixel was multiplied by, shape (M,).
        """
        total = sums @ self._signs
        if self._theta is None:
            return total
        some = slice(None, None, self._step)
        across = torch.zeros(len(sums), self._weighted.shape[1], dtype=torch.float64)
        across.index_add_(0, place[some], self._weighted * along[some, None])
        return total - across @ self._theta


def find_where(
    study: Study,
    chosen: tuple[str, ...] = (),
    residual: Tensor | None = None,
    binned: Sequence[Binned] | None = None,
) -> Where:
    """Test all covariates and the image map for a bias.

    Args:
        study: The recording.
        chosen: Effects of the model whose residual is tested.
        residual: The residual to test instead, of what was not fitted, shape (M,), metres.
        binned: The covariates in bins, where they are known; None: they are computed.
    """
    if residual is None:
        residual = left_out_residual(study, chosen, study.sums.ols)
        flips = Flips(study, residual, chosen)
    else:
        flips = Flips(study, residual)
    weight, unit, units = study.weight, study.unit_of_pixel, study.sums.num_units
    ones, parts = torch.ones_like(weight), list[tuple[Tensor, Tensor, Tensor]]()

    def per_pose(values: Tensor, place: Tensor, bins: int) -> Tensor:
        flat = torch.zeros(bins * units, dtype=torch.float64)
        return flat.index_add(0, place * units + unit, values).reshape(bins, units)

    def add(place: Tensor, bins: int, along: Tensor) -> None:
        own = per_pose(weight * residual * along, place, bins)
        counts = per_pose(weight * along**2, place, bins)
        parts.append((own, flips.of(own, place, along), counts))

    regions: list[tuple[str, float, float, bool]] = []
    for name, edges, place, scaled in binned_covariates(study) if binned is None else binned:
        add(place, len(edges) - 1, ones)
        regions += [(name, low, high, False) for low, high in pairwise(edges)]
        # Around the weighted mean, the coefficient of a line is its end minus its start.
        add(torch.zeros_like(unit), 1, scaled - (weight @ scaled) / weight.sum())
        regions.append((name, edges[0], edges[-1], True))
    tile = torch.zeros_like(unit)
    for count, position in zip(_TILES, (study.inputs.rows, study.inputs.columns), strict=True):
        tile = tile * count + ((position + 1) / 2 * count).long().clamp(max=count - 1)
    add(tile, _TILES[0] * _TILES[1], ones)
    sums, total, counts = (torch.cat(own) for own in zip(*parts, strict=True))
    offsets = per_pose(weight * residual, torch.zeros_like(unit), 1)[0]
    mean = offsets / per_pose(weight, torch.zeros_like(unit), 1)[0].clamp(min=TINY)
    return _assembled(sums, total, counts, regions, mean)


def _assembled(
    sums: Tensor,
    total: Tensor,
    counts: Tensor,
    regions: Sequence[tuple[str, float, float, bool]],
    offsets: Tensor,
) -> Where:
    """Compare all bins with their maximum under flips.

    Args:
        sums: Weighted residuals of every bin and pose, shape (R, U).
        total: Observed, then of every flip, shape (R, 1 + B).
        counts: Sums of the weights, shape (R, U).
        regions: Covariate, ends and whether it is a trend, of all bins but the image's.
        offsets: Mean residual of each pose, shape (U,), metres.
    """
    spread = sums.square().sum(1).sqrt()
    enough = ((counts > 0).sum(1) >= min(_LEAST_UNITS, sums.shape[1])) & (spread > 0)
    spread = torch.maximum(total[:, 1:].square().mean(1).sqrt(), _LEAST_LEFT * spread)
    scaled = torch.where(enough[:, None], total.abs() / spread.clamp(min=TINY)[:, None], 0.0)
    observed, largest = scaled[:, 0], scaled[:, 1:].amax(0)
    p_values = (1 + (largest >= (1 - _ROUNDING) * observed[:, None]).sum(1)) / (len(largest) + 1)
    critical, weight = float(torch.quantile(largest, 0.95)), counts.sum(1).clamp(min=TINY)
    bias, half = total[:, 0] / weight, critical * spread / weight
    found = [
        Region(
            covariate=name,
            low=low,
            high=high,
            bias=float(bias[i]),
            interval=(float(bias[i] - half[i]), float(bias[i] + half[i])),
            p_value=float(p_values[i]),
            trend=trend,
        )
        for i, (name, low, high, trend) in enumerate(regions)
        if bool(enough[i])
    ]
    scores = observed[: len(regions)][enough[: len(regions)]].tolist()
    order = sorted(range(len(found)), key=lambda place: -scores[place])
    tiles = slice(len(regions), None)
    return Where(
        regions=tuple(found[place] for place in order),
        tiles=torch.where(enough, bias, torch.nan)[tiles].reshape(_TILES).numpy(),
        tile_p_values=p_values[tiles].reshape(_TILES).numpy(),
        offsets=offsets.numpy(),
    )


StageName = Literal["as_given", "recalibrated", "with_effects"]


@dataclass(frozen=True)
class Stage:
    """The gap at one stage.

    Attributes:
        name: Which stage.
        gap, interval: Root mean square in excess of the noise, metres, with 95 % interval; None at
            the stage as given if no simulator was.
        where: The bias along all covariates and over the image; None likewise.
    """

    name: StageName
    gap: float | None
    interval: Interval | None
    where: Where | None

    @property
    def found_where(self) -> Where:
        """Where the bias lies, at a stage that exists."""
        if self.where is None:
            raise ValueError(f"There is no stage {self.name}: no simulator was given.")
        return self.where


def stages_of(
    study: Study, named: NamedEffects, gap: Gap, residual: Tensor | None
) -> tuple[Stage, Stage, Stage]:
    """Return the three stages.

    Args:
        study: The recording, before any effect was named.
        named: The effects named.
        gap: Before and after them.
        residual: Of the simulator as given, shape (M,), metres; None: none was given.
    """
    binned, as_given = binned_covariates(study), None
    if residual is not None:
        as_given = find_where(study, residual=residual, binned=binned)
    recalibrated = with_effects = find_where(study, binned=binned)
    if named.names or named.refined_terms:
        with_effects = find_where(named.study, named.columns, binned=binned)
    return (
        Stage("as_given", gap.as_given, gap.as_given_interval, as_given),
        Stage("recalibrated", gap.before, gap.before_interval, recalibrated),
        Stage("with_effects", gap.after, gap.after_interval, with_effects),
    )
