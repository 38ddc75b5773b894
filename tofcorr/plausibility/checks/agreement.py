"""Do poses, planes and depth agree, and if not, which mistake explains it?"""

import math

import numpy as np

from tofcorr.plausibility.checks import remounting, scale, wrapping
from tofcorr.plausibility.checks.outlying_poses import outlying_frames
from tofcorr.plausibility.explanations import Explanation, explanations
from tofcorr.plausibility.finding import Finding, Severity
from tofcorr.plausibility.look import Look

# Distance of whole frames from their planes, metres, from which explanations are tried, and which
# is doubtful if there is none; and the same in times the flatness of the walls, since noise of the
# pixels moves planes as well. Chosen: of 72 clean recordings the most had 2.5 mm, and of 60 of
# another generator without a fault none had more than both.
_SUSPICIOUS, _SHARE_OF_FLATNESS = 0.005, 0.5
# The two where errors of the camera cannot be told. Chosen: clean recordings stay below.
_SUSPICIOUS_ROUGH, _DOUBTFUL_ROUGH = 0.012, 0.03
# An explanation must leave no more than this, metres, or so many times the flatness. Chosen.
_ACCEPTABLE, _TIMES_FLAT = 0.02, 4.0
# An explanation is named if it leaves at most this share of the misfit, and takes off this many
# metres. Chosen.
_FAR_BETTER, _GAIN = 0.5, 0.008
# Of several, the first listed that comes this near the best is named. Chosen.
_AS_GOOD = 1.3
# Misfit from which a named mistake makes a fit meaningless, metres. Chosen: below, a fit is wrong
# by about as much as it is to correct.
_MEANINGLESS = 0.025
# The same where only the planes are wrong, and the angle in degrees that is as bad. Chosen: planes
# a few degrees off are what `diagnose` finds as target_registration.
_WRONG_PLANES, _WRONG_ANGLE = 0.06, 15.0
# Misfit beyond the flatness that no mistake explains, and of half of the frames: no calibration is
# to be used, and meaningless, metres. Chosen.
_UNUSABLE, _HOPELESS = 0.008, 0.05
# Constant error of the distance that is odd, and worth a note, metres. Chosen.
_ODD_CONSTANT, _LARGE_CONSTANT = 0.15, 0.2


def check(look: Look) -> list[Finding]:
    """Align points with planes, and try the usual mistakes where that leaves too much."""
    given = look.as_given
    if given is None:
        return []
    rough = look.shape is None
    excess = _excess(look)
    odd = abs(given.constant) > _ODD_CONSTANT or abs(given.slope) > scale.SLOPE
    fine = max(_SUSPICIOUS, _SHARE_OF_FLATNESS * look.flatness)
    if excess < (_SUSPICIOUS_ROUGH if rough else fine) and not odd:
        return scale.check(look)
    named = _best(look)
    if named:
        return [_explained(look, named)]
    if excess > (_DOUBTFUL_ROUGH if rough else fine):
        # A camera that moved on the tool explains it, unless by far too much.
        moved = [] if excess > _HOPELESS else remounting.check(look)
        return moved or wrapping.check(look) or [_unexplained(look)]
    return [*scale.check(look), *_far_constant(look)]


def _excess(look: Look) -> float:
    """Return how far frames are off their planes as wholes, metres.

    Root mean square over the frames that do not disagree with all others; where errors of the
    camera cannot be told, of the median frame, beyond the flatness of the walls.
    """
    if look.planes_off is None:
        return math.sqrt(max(float(np.median(look.rms)) ** 2 - look.flatness**2, 0.0))
    off = look.planes_off[~np.isin(look.frames, list(outlying_frames(look)))]
    return math.sqrt(float(np.nanmean(off**2))) if np.isfinite(off).any() else 0.0


def _far_constant(look: Look) -> list[Finding]:
    """Judge a constant error that fits all frames and is large for a camera."""
    given = look.as_given
    assert given is not None
    if abs(given.constant) <= _LARGE_CONSTANT:
        return []
    return [
        Finding(
            "agreement",
            "note",
            f"The distances are {1e3 * given.constant:+.0f} mm off on the whole, much for a "
            "camera: is this the depth of the target, and in metres?",
        )
    ]


def _best(look: Look) -> list[Explanation]:
    """Return the explanations that are about as good as the best and far better than none."""
    given = look.as_given
    assert given is not None
    most = max(_ACCEPTABLE, _TIMES_FLAT * look.flatness)
    better = [
        one
        for one in explanations(look)
        if one.found.badness <= min(_FAR_BETTER * given.badness, most)
        and given.badness - one.found.badness > _GAIN
        and (not one.frees or one.found.misfit <= _FAR_BETTER * given.misfit)
    ]
    least = min((one.found.badness for one in better), default=0.0)
    return [one for one in better if one.found.badness <= _AS_GOOD * least]


def _explained(look: Look, named: list[Explanation]) -> Finding:
    one = named[0]
    # A mirrored image and a mirrored world look alike; say both.
    other = next((more for more in named if more.advice != one.advice and not more.frees), None)
    also = f" (as likely: {other.cause})" if other is not None and not one.frees else ""
    given = look.as_given
    assert given is not None
    angle = math.degrees(given.typical_angle)
    limit = _MEANINGLESS if one.fatal else _WRONG_PLANES
    turned = not one.fatal and angle > _WRONG_ANGLE
    severity: Severity = "impossible" if given.badness > limit or turned else "doubtful"
    return Finding(
        "agreement",
        severity,
        f"{_misfit(look)}, and by {_mm(one.found.misfit)} if one mistake is undone: {one.cause}"
        f"{also}; {one.advice}.",
        spoils=True,
    )


def _unexplained(look: Look) -> Finding:
    known, excess = look.planes == "known", _excess(look)
    unmeasured = "; if nobody measured the planes, use `planes: unknown`" if known else ""
    # Without the frequency, waves of the circular error cannot be told from wrong poses.
    waves = look.sample.recording.modulation_frequency is None
    unstated = "; state `modulation_frequency_hz` if you know it" if waves else ""
    far = int((look.rms > _HOPELESS).sum())
    others = f", {far} of {len(look.rms)} frames more than {_mm(_HOPELESS)}" if far else ""
    return Finding(
        "agreement",
        "impossible" if excess > _HOPELESS else "doubtful",
        f"{_misfit(look)}{others}, and no usual mistake explains it: poses, planes or depth are of "
        f"something else, or the poses scatter{unmeasured}{unstated}.",
        spoils=excess > _UNUSABLE,
    )


def _misfit(look: Look) -> str:
    given = look.as_given
    assert given is not None
    angle = math.degrees(given.typical_angle)
    turned = f" and {angle:.0f} degrees" if np.isfinite(angle) and angle >= 2 else ""
    constant = (
        f", with all distances {1e3 * given.constant:+.0f} mm off"
        if abs(given.constant) > _LARGE_CONSTANT
        else ""
    )
    planes = "walls" if look.planes == "unknown" else "recorded planes"
    return (
        f"After the best alignment of the camera the points lie {_mm(given.misfit)}{turned} off "
        f"the {planes}{constant}"
    )


def _mm(metres: float) -> str:
    return f"{1e3 * metres:.0f} mm" if metres < 10 else f"{metres:.0f} m"
