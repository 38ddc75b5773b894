"""The findings as plain values: the content of `diagnosis.json`, lengths in millimetres."""

from math import isfinite, isnan
from typing import Any

from tofcorr.diagnosis.findings.absorption import RankedEffect
from tofcorr.diagnosis.findings.cause_sets import CauseSet
from tofcorr.diagnosis.findings.gap import Gap, Interval
from tofcorr.diagnosis.findings.outliers import Outliers
from tofcorr.diagnosis.findings.shares import Share
from tofcorr.diagnosis.findings.where import Region, Stage
from tofcorr.diagnosis.rerun.closure import Closure
from tofcorr.diagnosis.rerun.degraded_stage import DegradedStage
from tofcorr.diagnosis.rerun.fitted_values import FittedValue
from tofcorr.diagnosis.rerun.transfer import Transfer

# Regions listed for each stage, the most significant first. Chosen: what fits beside a picture.
_REGIONS_OF_STAGE = 5


def gap_values(gap: Gap) -> dict[str, Any]:
    """Return the content of `gap_mm`."""
    return {
        "before": mm(gap.before),
        "before_ci": _interval_mm(gap.before_interval),
        "after": mm(gap.after),
        "after_ci": _interval_mm(gap.after_interval),
        "floor": mm(gap.floor),
        "closed_fraction": round(gap.closed, 4),
        "closed_ci": [round(end, 4) for end in gap.closed_interval],
        "floor_is_upper_bound": not gap.floor_from_repeats,
        "between_images": mm(gap.between_images),
        "fixed_pattern": mm(gap.fixed_pattern),
        "within_images": mm(gap.within_images),
    }


def stage_values(stage: Stage) -> dict[str, Any]:
    """Return an entry of `stages`."""
    regions = () if stage.where is None else stage.where.regions[:_REGIONS_OF_STAGE]
    return {
        "name": stage.name,
        "gap_mm": None if stage.gap is None else mm(stage.gap),
        "ci": None if stage.interval is None else _interval_mm(stage.interval),
        "where": [region_values(region) for region in regions],
    }


def set_values(own: CauseSet) -> dict[str, float]:
    """Return an entry of `cause_sets_close`: what members close over what the first one closes."""
    return {name: round(share, 3) for name, share in own.closes.items()}


def share_values(share: Share) -> dict[str, Any]:
    """Return an entry of `attribution`."""
    values: dict[str, Any] = {
        "cause": share.cause,
        "kind": share.kind,
        "share": round(share.share, 4),
        "ci": [round(end, 4) for end in share.interval],
    }
    if share.of_constant is not None:
        values["of_constant"] = round(share.of_constant, 4)
    return values


def ranked_values(entry: RankedEffect) -> dict[str, Any]:
    """Return the entry of a tested effect in `ranking`."""
    return {
        "effect": entry.name,
        "closes_mm": mm(entry.closes),
        "closed_fraction": round(entry.closed_fraction, 4),
        "p_value": round(entry.p_value, 5),
        "aliases": list(entry.aliases),
        "available": True,
        "missing": [],
        "gain": round(entry.gain, 2),
        "score": round(entry.score, 3),
        "absorbed": None if entry.absorbed is None else round(entry.absorbed, 3),
    }


def untested_values(name: str, missing: list[str]) -> dict[str, Any]:
    """Return the entry of an untestable effect in `ranking`."""
    return {
        "effect": name,
        "closes_mm": None,
        "closed_fraction": None,
        "p_value": None,
        "aliases": [],
        "available": False,
        "missing": missing,
    }


def outlier_values(outliers: Outliers) -> dict[str, Any]:
    """Return the content of `outliers`: shares of the pixels; a tile without pixels is null."""
    return {
        "deleted_share": round(outliers.deleted, 6),
        "reduced_share": round(outliers.reduced, 6),
        "rms_mm": mm(outliers.size),
        "map": [
            [None if isnan(share) else round(share, 4) for share in row]
            for row in outliers.tiles.tolist()
        ],
        "where": outliers.place,
    }


def closure_values(closure: Closure | None) -> dict[str, Any] | None:
    """Return the content of `closure_mm`."""
    if closure is None:
        return None
    return {
        "without_effects": mm(closure.without_effects),
        "with_effects": mm(closure.with_effects),
        "frames": closure.frames,
    }


def degraded_values(degraded: DegradedStage | None) -> dict[str, Any] | None:
    """Return the content of `degraded`."""
    if degraded is None:
        return None
    return {
        "gap_mm": mm(degraded.gap),
        "ci": _interval_mm(degraded.interval),
        "poses": degraded.poses,
        "left_out": list(degraded.left_out),
    }


def fitted_value_values(one: FittedValue) -> dict[str, Any]:
    """Return an entry of `fitted`, in the unit that it names; a symbol without value is null."""
    ends = None if one.interval is None else [_finite(end) for end in one.interval]
    return {
        "cause": one.cause,
        "kind": one.kind,
        "name": one.name,
        "unit": one.unit,
        "value": _finite(one.value),
        "ci": ends,
    }


def _finite(number: float) -> float | None:
    return float(f"{number:.6g}") if isfinite(number) else None


def transfer_values(transfer: Transfer | None) -> dict[str, Any] | None:
    """Return the content of `transfer_mm`."""
    if transfer is None:
        return None
    names = ("trained_on_sim", "trained_on_sim_with_effects", "trained_on_real")
    return {
        **{name: mm(getattr(transfer, name)) for name in names},
        "ci": dict(zip(names, map(_interval_mm, transfer.intervals), strict=True)),
        "gain_ci": _interval_mm(transfer.gain_interval),
    }


def region_values(region: Region) -> dict[str, Any]:
    """Return an entry of `where`."""
    return {
        "covariate": region.covariate,
        "from": region.low,
        "to": region.high,
        "bias_mm": mm(region.bias),
        "bias_ci": _interval_mm(region.interval),
        "p_value": round(region.p_value, 5),
        "kind": "trend" if region.trend else "bin",
    }


def mm(metres: float) -> float:
    """Return millimetres, rounded to 0.1 um."""
    return round(metres * 1e3, 4)


def _interval_mm(interval: Interval) -> list[float]:
    return [mm(interval[0]), mm(interval[1])]
