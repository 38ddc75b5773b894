"""The content of `diagnosis.json`: all findings of a diagnosis as plain values."""

import math
from typing import TYPE_CHECKING, Any

from tofcorr.diagnosis.report.mapping import (
    closure_values,
    degraded_values,
    fitted_value_values,
    gap_values,
    mm,
    outlier_values,
    ranked_values,
    region_values,
    set_values,
    share_values,
    stage_values,
    transfer_values,
    untested_values,
)

if TYPE_CHECKING:
    from tofcorr.diagnosis.report.result import DiagnosisResult

# Regions that diagnosis.json lists, the most significant first: more than anyone reads.
_MOST_REGIONS = 60


def content_of(result: "DiagnosisResult") -> dict[str, Any]:
    """Return the content of `diagnosis.json`: plain values, lengths in millimetres."""
    gap = result.gap
    return {
        "format": "tofcorr-diagnosis",
        "version": 2,
        "simulator": result.simulator_kind,
        "stages": [stage_values(stage) for stage in result.stages],
        "attribution": [share_values(share) for share in result.shares],
        "gap_mm": gap_values(gap),
        "parameter_gap_mm": {
            "as_given": None if gap.as_given is None else mm(gap.as_given),
            "refitted": mm(gap.before),
        },
        "detected": result.detected,
        "p_value": round(result.p_value, 5),
        "effects": list(result.effects),
        "cause_sets": [list(members) for members in result.cause_sets],
        "cause_sets_close": [set_values(own) for own in result.evidence.named.sets],
        "likeliest": list(result.likeliest),
        "unknown": result.unknown,
        "unknown_p_value": round(result.remainder.p_value, 5),
        "outliers": outlier_values(result.outliers),
        "ranking": [
            *(ranked_values(entry) for entry in result.ranking),
            *(untested_values(name, missing) for name, missing in result.missing.items()),
        ],
        "where": [region_values(region) for region in result.where.regions[:_MOST_REGIONS]],
        "transfer_mm": transfer_values(result.transfer),
        "fitted": [fitted_value_values(one) for one in result.fitted],
        "closure_mm": closure_values(result.closure),
        "degraded": degraded_values(result.degraded),
        **result.observables.to_dict(),
        "hand_eye_shift_mm": mm(gap.hand_eye_shift[0]),
        "hand_eye_shift_deg": round(math.degrees(gap.hand_eye_shift[1]), 5),
        "minimum_detectable_mm": {
            name: None if size is None else mm(size) for name, size in result.detectable.items()
        },
        "next_recording": list(result.advice),
        "verdict": result.verdict,
        "causes": list(result.causes),
        "remarks": list(result.remarks),
        "warnings": list(result.warnings),
        "unknown_score": round(result.remainder.score, 4),
        "remaining_share": round(result.remainder.remaining_share, 4),
        "fingerprint": list(result.remainder.fingerprint),
        "taken_up": list(result.refined_terms),
    }
