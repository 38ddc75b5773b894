"""What a bias may depend on: covariates of every pixel, in bins.

What flips of whole poses leave of sums of residuals once the model is fitted to them again.

Flipped residuals are no residuals: a fit would take part of them away, as it did of the observed
ones. Compared with them as they are, biases that the model absorbs hide those that it does not.

Finds where simulator and recording differ: along which covariates, where in the image.

For every bin b of a covariate and every pose u, S_ub is the weighted sum of the residuals, each
pose left out of its own fit. The statistic |sum_u S_ub| / sqrt(sum_u S_ub^2) is compared with its
maximum over all bins of all covariates when whole poses flip their sign.

The gap in three stages: the simulator as given, recalibrated, and with the effects named.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor

from tofcorr.conditions import OPTIONAL_CONDITIONS, condition
from tofcorr.diagnosis.findings.effect_comparison import left_out_residual
from tofcorr.diagnosis.findings.gap import Gap, Interval
from tofcorr.diagnosis.findings.naming import NamedEffects
from tofcorr.diagnosis.sums.study import Study
from tofcorr.simulation.effects.inputs import is_clock

# Bins of a covariate. Chosen: few enough that each bin holds many poses.
_BINS = 8
# Values of a covariate that are looked at first. Chosen.
_FEW = 1000


@dataclass(frozen=True, kw_only=True)
class Binned:
    """A covariate in bins.

    Attributes:
        name: Of the covariate.
        edges: Of its bins, in its unit.
        place: Bin of every pixel, shape (M,), int64.
        scaled: The covariate scaled to a range from 0 to 1, shape (M,).
    """

    name: str
    edges: tuple[float, ...]
    place: Tensor
    scaled: Tensor


def binned_covariates(study: Study) -> list[Binned]:
    """Return the covariates that have more than one value, in bins."""
    binned = []
    for name, values in covariates(study).items():
        edges = _edges(values)
        if len(edges) < 3:
            continue
        inner = torch.from_numpy(edges[1:-1])
        span = (values.max() - values.min()).clamp(min=1e-12)
        binned.append(
            Binned(
                name=name,
                edges=tuple(edges.tolist()),
                place=torch.bucketize(values.contiguous(), inner, right=True),
                scaled=(values - values.min()) / span,
            )
        )
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
    # Of most covariates the first few values already tell that there are many levels.
    levels = np.unique(values[:_FEW].numpy())
    if len(levels) <= _BINS:
        levels = np.unique(values.numpy())
    if len(levels) <= _BINS:
        if len(levels) < 2:
            return levels
        middles = (levels[:-1] + levels[1:]) / 2
        return np.concatenate([levels[:1], middles, levels[-1:]])
    return np.unique(np.quantile(values.numpy(), np.linspace(0, 1, _BINS + 1)))


# Pixels that tell how much of a sum a fit takes, at most, evenly spread. Chosen: a sum over a tenth
# of them is known to 2 %, well below `_LEAST_LEFT` of `where`.
_MOST_PIXELS = 20_000


class Flips:
    """Flips of residuals of what was not fitted: nothing is taken away.

    Args:
        study: The recording.
    """

    def __init__(self, study: Study) -> None:
        signs = study.signs
        # The first column is the observed residual.
        self._signs = torch.cat([torch.ones_like(signs[:1]), signs]).T

    def bins(self, sums: Tensor, place: Tensor) -> Tensor:
        """Return sums over bins, observed and of every flip, shape (bins, 1 + B).

        Args:
            sums: Weighted residuals of every bin and pose, shape (bins, U).
            place: Bin of each pixel, shape (M,), int64.
        """
        return sums @ self._signs

    def line(self, sums: Tensor, along: Tensor) -> Tensor:
        """Return sums weighted by position along a line, shape (1, 1 + B).

        Args:
            sums: Of every pose, shape (1, U).
            along: Position of each pixel, shape (M,).
        """
        return sums @ self._signs


class RefittedFlips(Flips):
    """The same for a model that is fitted to flipped residuals.

    Args:
        study: The recording.
        chosen: Effects of the model.
        residual: Shape (M,), metres.
    """

    def __init__(self, study: Study, chosen: Sequence[str], residual: Tensor) -> None:
        super().__init__(study)
        columns, sums = study.system.of(chosen), study.sums.ols
        weighted = (study.sums.scale * study.fit.share * residual)[:, None]
        scores = [study.observations.products(own, weighted)[..., 0] for own in columns]
        members = sums.layout.of(chosen)
        normal = sums.total[members][:, members] + sums.layout.prior_of(members)
        self._theta = torch.linalg.solve(normal, torch.cat(scores, dim=1).T @ self._signs)
        self._step = step = max(1, len(residual) // _MOST_PIXELS)
        self._weighted = torch.cat([own[::step] for own in columns], dim=1)
        self._weighted = self._weighted * (step * study.weight[::step, None])

    def bins(self, sums: Tensor, place: Tensor) -> Tensor:
        """Return sums over bins, less what the model takes of them."""
        across = torch.zeros(len(sums), self._weighted.shape[1], dtype=torch.float64)
        across.index_add_(0, place[:: self._step], self._weighted)
        return super().bins(sums, place) - across @ self._theta

    def line(self, sums: Tensor, along: Tensor) -> Tensor:
        """Return sums along a line, less what the model takes of them."""
        across = along[:: self._step] @ self._weighted
        return super().line(sums, along) - across @ self._theta


# Rows and columns of tiles in the image, and the number of poses that a bin needs for a test.
# Chosen: few enough that each bin holds many poses.
_TILES = (6, 8)
_LEAST_UNITS = 4
# Relative difference of two statistics that counts as none. A bin of few poses has flips that give
# what was observed; rounding, some 1e-15, must not decide about them. Chosen.
_ROUNDING = 1e-9
# Least standard deviation of a sum that the model was fitted to, over that of residuals that it was
# not. Chosen: what the model absorbs so far shows no bias, and how far is known to 2 %.
_LEAST_LEFT = 0.1


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
        flips = RefittedFlips(study, chosen, residual)
    else:
        flips = Flips(study)
    binned = binned_covariates(study) if binned is None else binned
    weight, unit = study.weight, study.unit_of_pixel
    units, weighted = study.sums.num_units, study.weight * residual
    sums, totals, counts, regions = [], [], [], []

    def add(place: Tensor, bins: int) -> None:
        cell = place * units + unit
        sums.append(_per_unit(weighted, cell, units, bins))
        totals.append(flips.bins(sums[-1], place))
        counts.append(_per_unit(weight, cell, units, bins))

    for each in binned:
        add(each.place, len(each.edges) - 1)
        regions += [(each.name, low, high, False) for low, high in pairwise(each.edges)]
        # Around the weighted mean, the coefficient of a line is its end minus its start.
        centred = each.scaled - (weight @ each.scaled) / weight.sum()
        sums.append(_per_unit(weighted * centred, unit, units))
        totals.append(flips.line(sums[-1], centred))
        counts.append(_per_unit(weight * centred**2, unit, units))
        regions.append((each.name, each.edges[0], each.edges[-1], True))
    first_tile, tiles = len(regions), _TILES[0] * _TILES[1]
    add(_tile_numbers(study), tiles)
    regions += [("image", float(number), float(number), False) for number in range(tiles)]
    found = _Sums(torch.cat(sums), torch.cat(totals), torch.cat(counts))
    return _assembled(study, found, regions, first_tile, residual)


class _Sums(NamedTuple):
    """Weighted residuals of every bin.

    Attributes:
        own: Of every pose, shape (R, U).
        total: Observed, then of every flip, shape (R, 1 + B).
        counts: Sums of the weights, shape (R, U).
    """

    own: Tensor
    total: Tensor
    counts: Tensor


def _per_unit(values: Tensor, cell: Tensor, units: int, bins: int = 1) -> Tensor:
    """Return the sums of values (M,) in each bin and pose, shape (bins, U).

    Args:
        values: Of the pixels.
        cell: Bin of each pixel, times the number of poses, plus its pose, shape (M,), int64.
        units: Number of poses, U.
        bins: Number of bins.
    """
    flat = torch.zeros(bins * units, dtype=torch.float64)
    return flat.index_add(0, cell, values).reshape(bins, units)


def _tile_numbers(study: Study) -> Tensor:
    rows, columns = _TILES
    row = ((study.inputs.rows + 1) / 2 * rows).long().clamp(max=rows - 1)
    column = ((study.inputs.columns + 1) / 2 * columns).long().clamp(max=columns - 1)
    return row * columns + column


def _assembled(
    study: Study,
    sums: _Sums,
    regions: list[tuple[str, float, float, bool]],
    first_tile: int,
    residual: Tensor,
) -> Where:
    enough = (sums.counts > 0).sum(1) >= min(_LEAST_UNITS, study.sums.num_units)
    spread = sums.own.square().sum(1).sqrt()
    enough &= spread > 0
    known = sums.total[:, 1:].square().mean(1).sqrt()
    spread = torch.maximum(known, _LEAST_LEFT * spread)
    scaled = sums.total.abs() / spread.clamp(min=1e-30)[:, None]
    observed, flipped = torch.where(enough[:, None], scaled, 0.0).split([1, len(scaled.T) - 1], 1)
    observed, largest = observed[:, 0], flipped.amax(0)
    p_values = (1 + (largest >= (1 - _ROUNDING) * observed[:, None]).sum(1)) / (len(largest) + 1)
    critical = float(torch.quantile(largest, 0.95))
    total = sums.counts.sum(1).clamp(min=1e-30)
    bias, half = sums.total[:, 0] / total, critical * spread / total
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
        for i, (name, low, high, trend) in enumerate(regions[:first_tile])
        if bool(enough[i])
    ]
    order = {
        id(r): float(s)
        for r, s in zip(found, observed[:first_tile][enough[:first_tile]], strict=True)
    }
    found.sort(key=lambda region: -order[id(region)])
    unit = study.unit_of_pixel
    units = study.sums.num_units
    own = _per_unit(study.weight * residual, unit, units)[0]
    own = own / _per_unit(study.weight, unit, units)[0].clamp(min=1e-30)
    return Where(
        regions=tuple(found),
        tiles=torch.where(enough, bias, torch.nan)[first_tile:].reshape(_TILES).numpy(),
        tile_p_values=p_values[first_tile:].reshape(_TILES).numpy(),
        offsets=own.numpy(),
    )


StageName = Literal["as_given", "recalibrated", "with_effects"]


@dataclass(frozen=True, kw_only=True)
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
    binned = binned_covariates(study)
    recalibrated = find_where(study, binned=binned)
    with_effects = recalibrated
    if named.names or named.refined_terms:
        with_effects = find_where(named.study, named.columns, binned=binned)
    return (
        Stage(
            name="as_given",
            gap=gap.as_given,
            interval=gap.as_given_interval,
            where=None if residual is None else find_where(study, residual=residual, binned=binned),
        ),
        Stage(
            name="recalibrated",
            gap=gap.before,
            interval=gap.before_interval,
            where=recalibrated,
        ),
        Stage(name="with_effects", gap=gap.after, interval=gap.after_interval, where=with_effects),
    )
