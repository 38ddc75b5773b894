"""Finds where simulator and recording differ: along which covariates, where in the image.

For every bin b of a covariate and every pose u, S_ub is the weighted sum of the residuals, each
pose left out of its own fit. The statistic |sum_u S_ub| / sqrt(sum_u S_ub^2) is compared with its
maximum over all bins of all covariates when whole poses flip their sign. So is the slope of a line
along each covariate. This is done for the gap in three stages: the simulator as given,
recalibrated, and with the effects named.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from tofcorr.conditions import OPTIONAL_CONDITIONS, condition
from tofcorr.diagnosis.sums.observations import TINY
from tofcorr.diagnosis.sums.study import Study
from tofcorr.estimation.robust import LEVEL
from tofcorr.geometry.se3 import by_frame
from tofcorr.simulation.effects.base import is_clock

Interval = tuple[float, float]


def interval_of(draws: Sequence[float], estimate: float) -> Interval:
    """Return the percentile interval of some draws, widened to contain the estimate."""
    low, high = np.quantile(list(draws), [LEVEL / 2, 1 - LEVEL / 2])
    return min(float(low), estimate), max(float(high), estimate)


class Estimated(float):
    """A number with its draws and its 95 % interval, which contains it.

    Attributes:
        draws: Of the number; none where the interval was given.
        interval: Lower and upper end.
    """

    draws: Sequence[float]
    interval: Interval

    def __new__(
        cls, value: float = 0.0, draws: Sequence[float] = (), interval: Interval | None = None
    ) -> "Estimated":
        """Return a number with the interval given, or else that of its draws."""
        made = super().__new__(cls, value)
        made.draws, made.interval = draws, interval or interval_of(draws or [value], float(value))
        return made

    @classmethod
    def of(cls, values: Tensor | np.ndarray) -> "Estimated":
        """Return the first of some values, and all others, (1 + B,), as its draws."""
        first, *draws = values.tolist()
        return cls(first, draws)


@dataclass(frozen=True)
class Region:
    """A bin of a covariate.

    Attributes:
        covariate: Its name.
        low, high: Its ends, in the unit of the covariate.
        trend: Whether this is the change along the whole covariate, fitted by a line, not one bin.
        bias: Mean residual, metres; its interval is simultaneous over all regions.
        p_value: Adjusted for the number of regions.
    """

    covariate: str
    low: float
    high: float
    trend: bool = False
    bias: Estimated = field(default_factory=Estimated)
    p_value: float = 1.0


TILES = (6, 8)
"""Rows and columns of tiles in the image. Chosen: few enough that each holds many poses."""


@dataclass(frozen=True, kw_only=True)
class Stage:
    """The gap at one stage, and the bias there along all covariates and over the image.

    Attributes:
        name: Which stage.
        gap: Root mean square in excess of the noise, metres; None at the stage as given if no
            simulator was: nothing else is known of it.
        regions: Bins and trends of covariates, the most significant first.
        tiles: Bias of each tile of the image, shape (rows, columns), metres.
        tile_p_values: Their adjusted p-values, shape (rows, columns).
        offsets: Mean residual of each pose, shape (U,), metres.
    """

    name: Literal["as_given", "recalibrated", "with_effects"]
    gap: Estimated | None = None
    regions: tuple[Region, ...] = ()
    tiles: np.ndarray = field(default_factory=lambda: np.full(TILES, np.nan))
    tile_p_values: np.ndarray = field(default_factory=lambda: np.ones(TILES))
    offsets: np.ndarray = field(default_factory=lambda: np.zeros(0))

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


def left_out_residual(study: Study, chosen: Sequence[str]) -> Tensor:
    """Return residuals of a model of some effects with the variance of the errors, (M,), metres."""
    parts, left = study.columns_of(chosen), study.residual
    theta = study.sums.ols.left_out_solutions(chosen)[study.observations.unit][:, :, None]
    of_parts = theta.split([part.shape[1] for part in parts], dim=1)
    for part, own in zip(parts, of_parts, strict=True):
        left = left - by_frame(part, own, study.observations.frame)[:, 0]
    return left


def binned_covariates(study: Study) -> list[Binned]:
    """Return the covariates that have more than one value, in bins."""
    binned: list[Binned] = []
    for name, values in covariates(study).items():
        edges = _edges(values.numpy())
        if len(edges) < 3:
            continue
        place = torch.bucketize(values.contiguous(), torch.from_numpy(edges[1:-1]), right=True)
        span = (values.max() - values.min()).clamp(min=TINY)
        binned.append((name, tuple(edges.tolist()), place, (values - values.min()) / span))
    return binned


def covariates(study: Study) -> dict[str, Tensor]:
    """Return what a bias may depend on, for each pixel, by name; units as in the recording."""
    inputs, facts, camera = study.inputs, study.inputs.facts, study.inputs.camera
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
    if is_clock(facts.timestamp):
        found[condition("timestamp").covariate] = inputs.of_frame(facts.timestamp)
    for each in OPTIONAL_CONDITIONS:
        if (values := getattr(facts, each.name)) is not None:
            found[each.covariate] = inputs.of_frame(each.in_file(values))
    found["frame"] = inputs.frame.double()
    if study.observations.recording.moves:
        found["target_x_m"], found["target_y_m"] = inputs.target_xy.unbind(1)
        place = inputs.of_frame(facts.world_from_tool[:, :3, 3])
        found |= {f"tool_{axis}_m": own for axis, own in zip("xyz", place.unbind(1), strict=True)}
    return {name: values for name, values in found.items() if bool(values.isfinite().all())}


def _edges(values: np.ndarray) -> np.ndarray:
    """Return edges of bins with equally many pixels; a covariate of few levels gets a bin each.

    There are eight at most, few enough that each holds many poses.
    """
    bins = 8
    levels = np.unique(values[:1000])  # Of most covariates these tell that there are many.
    if len(levels) <= bins:
        levels = np.unique(values)
    if len(levels) > bins:
        return np.unique(np.quantile(values, np.linspace(0, 1, bins + 1)))
    if len(levels) < 2:
        return levels
    return np.concatenate([levels[:1], (levels[:-1] + levels[1:]) / 2, levels[-1:]])


def flipped(
    study: Study, residual: Tensor, chosen: Sequence[str] | None = None
) -> Callable[[Tensor, Tensor, Tensor], Tensor]:
    """Return what gives sums of residuals, observed and when whole poses flip their sign.

    Flipped residuals of a fit are no residuals: a fit would take part of them away, as it did of
    the observed ones. Compared with them as they are, biases that the model absorbs hide those that
    it does not. So the model is fitted to them again.

    Args:
        study: The recording.
        residual: Shape (M,), metres.
        chosen: Effects of the model that was fitted; None: the residual is of no fit.

    Returns:
        Takes weighted residuals of every bin and pose, shape (bins, U), the bin of each pixel,
        (M,), and what each residual was multiplied by, (M,). Returns sums over the bins, observed
        and of every flip, shape (bins, 1 + B).
    """
    # The first column is the observed residual.
    signs = torch.cat([torch.ones_like(study.signs[:1]), study.signs]).T
    if chosen is None:
        return lambda sums, place, along: sums @ signs
    columns, ols = study.columns_of(chosen), study.sums.ols
    weighted = (ols.scale * study.fit.share * residual)[:, None]
    scores = [study.observations.products(own, weighted)[..., 0] for own in columns]
    theta = torch.linalg.solve(ols.normal(chosen), torch.cat(scores, dim=1).T @ signs)
    # So many, evenly spread, tell how much of a sum a fit takes: over a tenth of them to 2 %.
    step = max(1, len(residual) // 20_000)
    some = slice(None, None, step)
    taken = step * study.weight[some, None] * torch.cat([own[some] for own in columns], dim=1)

    def sums_of(sums: Tensor, place: Tensor, along: Tensor) -> Tensor:
        across = torch.zeros(len(sums), taken.shape[1], dtype=torch.float64)
        across.index_add_(0, place[some], taken * along[some, None])
        return sums @ signs - across @ theta

    return sums_of


def find_where(
    study: Study,
    stage: Stage,
    binned: Sequence[Binned],
    chosen: Sequence[str] | None = (),
    residual: Tensor | None = None,
) -> Stage:
    """Test all covariates and the image map for a bias; return the stage with what was found.

    All bins that four poses show are compared with their maximum under flips.

    Args:
        study: The recording.
        stage: Which stage, and the gap there.
        binned: The covariates in bins.
        chosen: Effects of the model whose residual is tested; None: `residual` is, of no fit.
        residual: Of what was not fitted, shape (M,), metres.
    """
    if residual is None:
        residual = left_out_residual(study, chosen or ())
    flips = flipped(study, residual, chosen)
    weight, unit, units = study.weight, study.unit_of_pixel, study.sums.num_units
    places, regions = list[tuple[Tensor, int, Tensor]](), list[Region]()
    one_bin, ones = torch.zeros_like(unit), torch.ones_like(weight)
    for covariate, edges, place, scaled in binned:
        # Around the weighted mean, the coefficient of a line is its end minus its start.
        line = scaled - (weight @ scaled) / weight.sum()
        places += [(place, len(edges) - 1, ones), (one_bin, 1, line)]
        regions += [Region(covariate, low, high) for low, high in pairwise(edges)]
        regions.append(Region(covariate, edges[0], edges[-1], trend=True))
    tile = one_bin
    for count, position in zip(TILES, (study.inputs.rows, study.inputs.columns), strict=True):
        tile = tile * count + ((position + 1) / 2 * count).long().clamp(max=count - 1)
    places += [(tile, TILES[0] * TILES[1], ones), (one_bin, 1, ones)]

    def per_pose(values: Tensor, place: Tensor, bins: int) -> Tensor:
        flat = torch.zeros(bins * units, dtype=torch.float64)
        return flat.index_add(0, place * units + unit, values).reshape(bins, units)

    parts = []
    for place, bins, along in places:
        own = per_pose(weight * residual * along, place, bins)
        counts = per_pose(weight * along**2, place, bins)
        parts.append((own, flips(own, place, along), counts))
    sums, total, counts = (torch.cat(own) for own in zip(*parts, strict=True))
    offsets = sums[-1] / counts[-1].clamp(min=TINY)
    sums, total, counts = sums[:-1], total[:-1], counts[:-1]
    spread = sums.square().sum(1).sqrt()
    enough = ((counts > 0).sum(1) >= min(4, sums.shape[1])) & (spread > 0)
    # What the model absorbs to a tenth shows no bias: how far it does is known to 2 %.
    spread = torch.maximum(total[:, 1:].square().mean(1).sqrt(), spread / 10)
    scaled = torch.where(enough[:, None], total.abs() / spread.clamp(min=TINY)[:, None], 0.0)
    observed, largest = scaled[:, 0], scaled[:, 1:].amax(0)
    # A bin of few poses has flips that give what was observed, but for rounding.
    as_large = (largest > observed[:, None]) | torch.isclose(largest, observed[:, None])
    p_values = (1 + as_large.sum(1).double()) / (len(largest) + 1)
    critical, weight = float(torch.quantile(largest, 1 - LEVEL)), counts.sum(1).clamp(min=TINY)
    bias, half = total[:, 0] / weight, critical * spread / weight
    found = []
    for place in observed[: len(regions)].argsort(descending=True, stable=True).tolist():
        size, reach = float(bias[place]), float(half[place])
        size = Estimated(size, interval=(size - reach, size + reach))
        if bool(enough[place]):
            found.append(replace(regions[place], bias=size, p_value=float(p_values[place])))
    tiles = slice(len(regions), None)
    return replace(
        stage,
        regions=tuple(found),
        tiles=torch.where(enough, bias, torch.nan)[tiles].reshape(TILES).numpy(),
        tile_p_values=p_values[tiles].reshape(TILES).numpy(),
        offsets=offsets.numpy(),
    )
