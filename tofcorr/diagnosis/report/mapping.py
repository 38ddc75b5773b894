"""The content of `diagnosis.json`: all findings of a diagnosis as plain values, lengths in mm."""

import math
from typing import TYPE_CHECKING, Any

from tofcorr.diagnosis.findings.absorption import absorbed_share
from tofcorr.diagnosis.findings.effect_comparison import EffectTest, closed_gap
from tofcorr.diagnosis.findings.naming import NamedEffects
from tofcorr.diagnosis.findings.where import Stage
from tofcorr.diagnosis.sums.study import Study

if TYPE_CHECKING:
    from tofcorr.diagnosis.report.result import DiagnosisResult


def content_of(result: "DiagnosisResult") -> dict[str, Any]:
    """Return the content of `diagnosis.json`."""
    gap, remainder, named = result.gap, result.remainder, result.evidence.named
    outliers, transfer, closure = result.outliers, result.transfer, result.closure
    degraded = result.degraded
    untested = {"closes_mm": None, "closed_fraction": None, "p_value": None, "aliases": []}
    lengths = "before", "after", "floor", "between_images", "fixed_pattern", "within_images"
    lists = "effects", "likeliest", "causes", "remarks", "warnings"
    trainings = "trained_on_sim", "trained_on_sim_with_effects", "trained_on_real"
    return {
        "format": "tofcorr-diagnosis",
        "version": 2,
        "simulator": result.simulator_kind,
        "stages": [
            {
                "name": stage.name,
                "gap_mm": _mm(stage.gap),
                "ci": None if stage.gap is None else _mm(stage.gap.interval),
                "where": _regions(stage, 5),  # What fits beside a picture.
            }
            for stage in result.stages
        ],
        "attribution": [
            {"cause": one.cause, "kind": one.kind, "share": round(one.share, 4)}
            | {"ci": _rounded(one.share.interval)}
            | ({} if one.of_constant is None else {"of_constant": round(one.of_constant, 4)})
            for one in result.shares
        ],
        "gap_mm": {
            **{name: _mm(getattr(gap, name)) for name in lengths},
            **{f"{name}_ci": _mm(getattr(gap, name).interval) for name in ("before", "after")},
            "closed_fraction": round(gap.closed, 4),
            "closed_ci": _rounded(gap.closed.interval),
            "floor_is_upper_bound": not gap.floor_from_repeats,
        },
        "parameter_gap_mm": {"as_given": _mm(gap.as_given), "refitted": _mm(gap.before)},
        "detected": result.detected,
        "p_value": round(result.p_value, 5),
        "cause_sets": [list(members) for members in result.cause_sets],
        # What members close over what the first one closes.
        "cause_sets_close": [
            {name: round(share, 3) for name, share in own.items() if math.isfinite(share)}
            for own in named.sets.values()
        ],
        "unknown": remainder.unknown,
        "unknown_p_value": round(remainder.p_value, 5),
        "outliers": {
            "deleted_share": round(outliers.deleted, 6),
            "reduced_share": round(outliers.reduced, 6),
            "rms_mm": _mm(outliers.size),
            "map": [_rounded(row) for row in outliers.tiles.tolist()],
            "where": outliers.place,
        },
        "ranking": [_ranked(result.evidence.study, named, test) for test in result.ranking]
        + [
            {"effect": name, **untested, "available": False, "missing": missing}
            for name, missing in result.missing.items()
        ],
        "where": _regions(result.stages[1], 60),  # More than anyone reads.
        "transfer_mm": transfer
        and {
            **{name: _mm(getattr(transfer, name)) for name in trainings},
            "ci": dict(zip(trainings, map(_mm, transfer.intervals), strict=True)),
            "gain_ci": _mm(transfer.gain_interval),
        },
        "fitted": [
            {name: getattr(one, name) for name in ("cause", "kind", "name", "unit")}
            | {"value": _finite(one.value), "ci": one.interval and [*map(_finite, one.interval)]}
            for one in result.fitted
        ],
        "closure_mm": closure
        and {name: _mm(getattr(closure, name)) for name in ("without_effects", "with_effects")}
        | {"frames": closure.frames},
        "degraded": degraded
        and {
            "gap_mm": _mm(degraded.gap),
            "ci": _mm(degraded.gap.interval),
            "poses": degraded.poses,
            "left_out": list(degraded.left_out),
        },
        **result.observables.to_dict(),
        "hand_eye_shift_mm": _mm(gap.hand_eye_shift[0]),
        "hand_eye_shift_deg": round(math.degrees(gap.hand_eye_shift[1]), 5),
        "minimum_detectable_mm": {name: _mm(size) for name, size in result.detectable.items()},
        "next_recording": list(result.advice),
        "verdict": result.verdict,
        **{name: list(getattr(result, name)) for name in lists},
        "unknown_score": round(remainder.score, 4),
        "remaining_share": round(remainder.remaining_share, 4),
        "fingerprint": list(remainder.fingerprint),
        "taken_up": list(result.refined_terms),
    }


def _ranked(study: Study, named: NamedEffects, test: EffectTest) -> dict[str, Any]:
    """Return the entry of a tested effect in `ranking`."""
    closes, fraction = closed_gap(study, named.first, test)
    members = next((own for own in named.cause_sets if test.name in own), ())
    absorbed = None
    if test.name in study.candidates.effects:
        absorbed = round(absorbed_share(study, test.name), 3)
    return {
        "effect": test.name,
        "closes_mm": _mm(closes),
        "closed_fraction": round(fraction, 4),
        "p_value": round(named.first.naming_p_value(test.name), 5),
        "aliases": [name for name in members if name != test.name],
        "available": True,
        "missing": [],
        "gain": round(test.gain, 2),
        "score": round(test.score, 3),
        "absorbed": absorbed,
    }


def _regions(stage: Stage, most: int) -> list[dict[str, Any]]:
    """Return entries of `where`, the most significant first."""
    return [
        {
            "covariate": region.covariate,
            "from": region.low,
            "to": region.high,
            "bias_mm": _mm(region.bias),
            "bias_ci": _mm(region.bias.interval),
            "p_value": round(region.p_value, 5),
            "kind": "trend" if region.trend else "bin",
        }
        for region in stage.regions[:most]
    ]


def _mm(metres: float | tuple[float, float] | None) -> Any:  # noqa: ANN401 - as what is given
    """Return a length or an interval in millimetres, rounded to 0.1 um; None stays None."""
    if isinstance(metres, tuple):
        return [_mm(end) for end in metres]
    return None if metres is None else round(metres * 1e3, 4)


def _rounded(shares: tuple[float, float] | list[float]) -> list[float | None]:
    """Return shares to four digits; None: it is not known."""
    return [None if math.isnan(share) else round(share, 4) for share in shares]


def _finite(number: float) -> float | None:
    return float(f"{number:.6g}") if math.isfinite(number) else None
