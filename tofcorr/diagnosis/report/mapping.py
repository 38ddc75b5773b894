"""The content of `diagnosis.json`: all findings of a diagnosis as plain values, lengths in mm."""

import math
from typing import TYPE_CHECKING, Any

from tofcorr.diagnosis.findings.absorption import RankedEffect
from tofcorr.diagnosis.findings.where import Region

if TYPE_CHECKING:
    from tofcorr.diagnosis.report.result import DiagnosisResult

# Regions listed, the most significant first: of the gap, more than anyone reads; of each stage,
# what fits beside a picture.
_MOST_REGIONS, _REGIONS_OF_STAGE = 60, 5
_GAPS = ("before", "after", "floor", "between_images", "fixed_pattern", "within_images")
_TRAININGS = ("trained_on_sim", "trained_on_sim_with_effects", "trained_on_real")


def content_of(result: "DiagnosisResult") -> dict[str, Any]:
    """Return the content of `diagnosis.json`."""
    gap, remainder, named = result.gap, result.remainder, result.evidence.named
    untested = {"closes_mm": None, "closed_fraction": None, "p_value": None, "aliases": []}
    return {
        "format": "tofcorr-diagnosis",
        "version": 2,
        "simulator": result.simulator_kind,
        "stages": [
            {
                "name": stage.name,
                "gap_mm": _mm(stage.gap),
                "ci": _mm(stage.interval),
                "where": [
                    _region(one)
                    for one in (stage.where.regions[:_REGIONS_OF_STAGE] if stage.where else ())
                ],
            }
            for stage in result.stages
        ],
        "attribution": [
            {
                "cause": one.cause,
                "kind": one.kind,
                "share": round(one.share, 4),
                "ci": [round(end, 4) for end in one.interval],
            }
            | ({} if one.of_constant is None else {"of_constant": round(one.of_constant, 4)})
            for one in result.shares
        ],
        "gap_mm": {
            **{name: _mm(getattr(gap, name)) for name in _GAPS},
            "before_ci": _mm(gap.before_interval),
            "after_ci": _mm(gap.after_interval),
            "closed_fraction": round(gap.closed, 4),
            "closed_ci": [round(end, 4) for end in gap.closed_interval],
            "floor_is_upper_bound": not gap.floor_from_repeats,
        },
        "parameter_gap_mm": {"as_given": _mm(gap.as_given), "refitted": _mm(gap.before)},
        "detected": result.detected,
        "p_value": round(result.p_value, 5),
        "effects": list(result.effects),
        "cause_sets": [list(members) for members in result.cause_sets],
        # What members close over what the first one closes.
        "cause_sets_close": [
            {name: round(share, 3) for name, share in own.closes.items()} for own in named.sets
        ],
        "likeliest": list(result.likeliest),
        "unknown": result.unknown,
        "unknown_p_value": round(remainder.p_value, 5),
        "outliers": {
            "deleted_share": round(result.outliers.deleted, 6),
            "reduced_share": round(result.outliers.reduced, 6),
            "rms_mm": _mm(result.outliers.size),
            "map": [  # A tile without pixels is null.
                [None if math.isnan(share) else round(share, 4) for share in row]
                for row in result.outliers.tiles.tolist()
            ],
            "where": result.outliers.place,
        },
        "ranking": [
            *map(_ranked, result.ranking),
            *(
                {"effect": name, **untested, "available": False, "missing": missing}
                for name, missing in result.missing.items()
            ),
        ],
        "where": [_region(region) for region in result.where.regions[:_MOST_REGIONS]],
        "transfer_mm": result.transfer
        and {
            **{name: _mm(getattr(result.transfer, name)) for name in _TRAININGS},
            "ci": dict(zip(_TRAININGS, map(_mm, result.transfer.intervals), strict=True)),
            "gain_ci": _mm(result.transfer.gain_interval),
        },
        "fitted": [
            {name: getattr(one, name) for name in ("cause", "kind", "name", "unit")}
            | {
                "value": _finite(one.value),
                "ci": one.interval and [_finite(end) for end in one.interval],
            }
            for one in result.fitted
        ],
        "closure_mm": result.closure
        and {
            "without_effects": _mm(result.closure.without_effects),
            "with_effects": _mm(result.closure.with_effects),
            "frames": result.closure.frames,
        },
        "degraded": result.degraded
        and {
            "gap_mm": _mm(result.degraded.gap),
            "ci": _mm(result.degraded.interval),
            "poses": result.degraded.poses,
            "left_out": list(result.degraded.left_out),
        },
        **result.observables.to_dict(),
        "hand_eye_shift_mm": _mm(gap.hand_eye_shift[0]),
        "hand_eye_shift_deg": round(math.degrees(gap.hand_eye_shift[1]), 5),
        "minimum_detectable_mm": {name: _mm(size) for name, size in result.detectable.items()},
        "next_recording": list(result.advice),
        "verdict": result.verdict,
        **{name: list(getattr(result, name)) for name in ("causes", "remarks", "warnings")},
        "unknown_score": round(remainder.score, 4),
        "remaining_share": round(remainder.remaining_share, 4),
        "fingerprint": list(remainder.fingerprint),
        "taken_up": list(result.refined_terms),
    }


def _ranked(entry: RankedEffect) -> dict[str, Any]:
    """Return the entry of a tested effect in `ranking`."""
    return {
        "effect": entry.name,
        "closes_mm": _mm(entry.closes),
        "closed_fraction": round(entry.closed_fraction, 4),
        "p_value": round(entry.p_value, 5),
        "aliases": list(entry.aliases),
        "available": True,
        "missing": [],
        "gain": round(entry.gain, 2),
        "score": round(entry.score, 3),
        "absorbed": None if entry.absorbed is None else round(entry.absorbed, 3),
    }


def _region(region: Region) -> dict[str, Any]:
    """Return an entry of `where`."""
    return {
        "covariate": region.covariate,
        "from": region.low,
        "to": region.high,
        "bias_mm": _mm(region.bias),
        "bias_ci": _mm(region.interval),
        "p_value": round(region.p_value, 5),
        "kind": "trend" if region.trend else "bin",
    }


def _mm(metres: float | tuple[float, float] | None) -> Any:  # noqa: ANN401 - as what is given
    """Return a length or an interval in millimetres, rounded to 0.1 um; None stays None."""
    if isinstance(metres, tuple):
        return [_mm(end) for end in metres]
    return None if metres is None else round(metres * 1e3, 4)


def _finite(number: float) -> float | None:
    return float(f"{number:.6g}") if math.isfinite(number) else None
