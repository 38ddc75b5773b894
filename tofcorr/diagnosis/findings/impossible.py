"""Gaps that no effect of a camera explains: poses, planes, units or intrinsics are wrong."""

import math

from tofcorr.diagnosis.sums.observations import predicted_distance
from tofcorr.diagnosis.sums.study import Study
from tofcorr.errors import CalibrationDataError
from tofcorr.plausibility.finding import Inspection, in_words
from tofcorr.spread import sigma_from_mad

LARGEST_GAP = 0.2
"""Gap, metres, above which no cause is named. Every effect of the catalogue together makes less at
the range of a depth camera; geometry that is wrong makes more."""


def refuse_impossible_gap(study: Study, inspection: Inspection) -> None:
    """Refuse to name causes of a gap that remains after recalibration and is too large for any.

    Args:
        study: The recording, with its base fit.
        inspection: What is odd about the recording.

    Raises:
        CalibrationDataError: The gap is above `LARGEST_GAP`, or not a number.
    """
    gap = _missed(study)
    if gap <= LARGEST_GAP:
        return
    odd, remedy = " ".join(f"- {one.sentence}" for one in inspection.findings), ""
    if inspection.outlying:  # A training leaves them out by itself.
        frames = in_words(tuple(inspection.outlying))
        remedy = f"Leave {frames} out of the recording, or mend them. "
    size = f"by {1e3 * gap:.0f} mm" if gap < 1 else "by more than a metre"
    raise CalibrationDataError(
        f"{study.observations.recording.path}: even for a camera fitted to them distances and "
        f"planes disagree {size}, and no effect of a camera makes more than "
        f"{1e3 * LARGEST_GAP:.0f} mm: poses, planes, units or intrinsics are wrong. Odd about the "
        f"recording: {odd or 'nothing else.'} {remedy}"
        "(--force, in Python force=True, names causes all the same.)"
    )


def _missed(study: Study) -> float:
    """Return by how much distances and planes disagree, metres; infinite: not a number.

    That is the larger of two: the error of each pose beside all others, and the spread of the
    distances about those to the planes, with no error model but a constant. A fit without a pose
    that alone shows a range of distances misses it by any amount, so `left_out_solutions` give the
    errors. They alone would be too small: an error model of the distance turns poses that are off
    by a metre into a camera that reads the same distance everywhere, and misses by the spread of
    its readings.
    """
    ols = study.sums.ols
    errors = ols.squares_at((), ols.left_out_solutions(()))
    square = float(errors.sum() / study.sums.count.sum())
    observations = study.observations
    off = observations.measured - predicted_distance(observations, study.fit.tool_from_camera)
    spread = float(sigma_from_mad((off - off.median()).abs().median()))
    if not (math.isfinite(square) and math.isfinite(spread)):
        return math.inf
    return max(math.sqrt(max(square - study.fit.floor**2, 0.0)), spread)


def headline_of_given(as_given: float | None) -> str | None:
    """Return what to say first of a simulator that is off by more than any camera's effects.

    Args:
        as_given: The gap of the simulator as given, metres; None: there is none.
    """
    if as_given is None or as_given <= LARGEST_GAP:
        return None
    return (
        f"Doubtful simulator: as given it is off by more than {1e3 * LARGEST_GAP:.0f} mm, which is "
        "geometry rather than light: check its poses, its hand-eye transform and its unit first."
    )
