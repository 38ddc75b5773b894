"""Finds where simulator and recording differ: along which covariates, where in the image.

For every bin b of a covariate and every pose u, S_ub is the weighted sum of the residuals, each
pose left out of its own fit. The statistic |sum_u S_ub| / sqrt(sum_u S_ub^2) is compared with its
maximum over all bins of all covariates when whole poses flip their sign.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from tofcorr.conditions import OPTIONAL_CONDITIONS, condition
from tofcorr.diagnosis.findings.effect_comparison import left_out_residual
from tofcorr.diagnosis.sums.study import Study

# Bins of a covariate, rows and columns of tiles in the image, and the number of poses that a bin
# needs for a test. Chosen: few enough that each bin holds many poses.
_BINS = 8
_TILES = (6, 8)
_LEAST_UNITS = 4
# Values of a covariate that are looked at first. Chosen.
_FEW = 1000
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


def find_where(study: Study, chosen: tuple[str, ...] = (), residual: Tensor | None = None) -> Where:
    """Test all covariates and the image map for a bias.

    Args:
        study: The recording.
        chosen: Effects of the model whose residual is tested.
        residual: The residual to test instead, of what was not fitted, shape (M,), metres.
    """
    if residual is None:
        residual = left_out_residual(study, chosen)
    weight, unit = study.weight, study.unit_of_pixel
    units = study.system.blocks.num_units
    sums, counts, regions = [], [], []

    def add(place: Tensor, bins: int) -> None:
        sums.append(_per_unit(weight * residual, unit, units, place, bins))
        counts.append(_per_unit(weight, unit, units, place, bins))

    for name, values in covariates(study).items():
        edges = _edges(values)
        if len(edges) < 3:
            continue
        add(
            torch.bucketize(values.contiguous(), torch.from_numpy(edges[1:-1]), right=True),
            len(edges) - 1,
        )
        regions += [(name, float(low), float(high), False) for low, high in pairwise(edges)]
        centred = _centred(values, weight)
        sums.append(_per_unit(weight * centred * residual, unit, units))
        counts.append(_per_unit(weight * centred**2, unit, units))
        regions.append((name, float(edges[0]), float(edges[-1]), True))
    first_tile, tiles = len(regions), _TILES[0] * _TILES[1]
    add(_tile_numbers(study), tiles)
    regions += [("image", float(number), float(number), False) for number in range(tiles)]
    return _assembled(study, torch.cat(sums), torch.cat(counts), regions, first_tile, residual)


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
    known = {condition("timestamp").covariate: facts.timestamp}
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


def _centred(values: Tensor, weight: Tensor) -> Tensor:
    """Scale to a range of one around the weighted mean; its coefficient is then end minus start."""
    span = (values.max() - values.min()).clamp(min=1e-12)
    scaled = (values - values.min()) / span
    return scaled - (weight * scaled).sum() / weight.sum()


def _per_unit(
    values: Tensor, unit: Tensor, units: int, place: Tensor | None = None, bins: int = 1
) -> Tensor:
    """Return the sums of values (M,) in each bin and pose, shape (bins, U); `place`: their bins."""
    index = unit if place is None else place * units + unit
    flat = torch.zeros(bins * units, dtype=torch.float64)
    return flat.index_add(0, index, values).reshape(bins, units)


def _tile_numbers(study: Study) -> Tensor:
    rows, columns = _TILES
    row = ((study.inputs.rows + 1) / 2 * rows).long().clamp(max=rows - 1)
    column = ((study.inputs.columns + 1) / 2 * columns).long().clamp(max=columns - 1)
    return row * columns + column


def _assembled(
    study: Study,
    sums: Tensor,
    counts: Tensor,
    regions: list[tuple[str, float, float, bool]],
    first_tile: int,
    residual: Tensor,
) -> Where:
    enough = (counts > 0).sum(1) >= min(_LEAST_UNITS, study.system.blocks.num_units)
    spread = (sums**2).sum(1).sqrt()
    enough &= spread > 0
    safe = spread.clamp(min=1e-30)
    observed = torch.where(enough, sums.sum(1).abs() / safe, 0.0)
    flipped = torch.where(
        enough[:, None], (sums @ study.resampling.signs.T).abs() / safe[:, None], 0.0
    )
    largest = flipped.amax(0)
    p_values = (1 + (largest >= (1 - _ROUNDING) * observed[:, None]).sum(1)) / (len(largest) + 1)
    critical = float(torch.quantile(largest, 0.95))
    total = counts.sum(1).clamp(min=1e-30)
    bias, half = sums.sum(1) / total, critical * spread / total
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
    units = study.system.blocks.num_units
    own = _per_unit(study.weight * residual, unit, units)[0]
    own = own / _per_unit(study.weight, unit, units)[0].clamp(min=1e-30)
    return Where(
        regions=tuple(found),
        tiles=torch.where(enough, bias, torch.nan)[first_tile:].reshape(_TILES).numpy(),
        tile_p_values=p_values[first_tile:].reshape(_TILES).numpy(),
        offsets=own.numpy(),
    )
