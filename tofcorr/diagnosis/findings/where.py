"""Finds where simulator and recording differ: along which covariates, where in the image.

For every bin b of a covariate and every pose u, S_ub is the weighted sum of the residuals, each
pose left out of its own fit. The statistic |sum_u S_ub| / sqrt(sum_u S_ub^2) is compared with its
maximum over all bins of all covariates when whole poses flip their sign.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from tofcorr.diagnosis.findings.covariates import Binned, binned_covariates
from tofcorr.diagnosis.findings.effect_gains import left_out_residual
from tofcorr.diagnosis.findings.refitted_flips import Flips, RefittedFlips
from tofcorr.diagnosis.sums.study import Study

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
        residual = left_out_residual(study, chosen, study.system.blocks.even)
        flips = RefittedFlips(study, chosen, residual)
    else:
        flips = Flips(study)
    binned = binned_covariates(study) if binned is None else binned
    weight, unit = study.weight, study.unit_of_pixel
    units, weighted = study.system.blocks.num_units, study.weight * residual
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
    enough = (sums.counts > 0).sum(1) >= min(_LEAST_UNITS, study.system.blocks.num_units)
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
    units = study.system.blocks.num_units
    own = _per_unit(study.weight * residual, unit, units)[0]
    own = own / _per_unit(study.weight, unit, units)[0].clamp(min=1e-30)
    return Where(
        regions=tuple(found),
        tiles=torch.where(enough, bias, torch.nan)[first_tile:].reshape(_TILES).numpy(),
        tile_p_values=p_values[first_tile:].reshape(_TILES).numpy(),
        offsets=own.numpy(),
    )
