"""Do robot and camera agree on lengths?"""

import math

from tofcorr.plausibility.finding import Finding
from tofcorr.plausibility.look import Look

# Error in proportion to the distance, after the prior of the alignment, from which on the usual
# mistakes are tried and which heads a report, and that is another unit. Chosen: of 319 cameras of
# other generators without such a fault one in 30 had more than the first (up to 5 %).
SLOPE, _OTHER_UNIT = 0.03, 0.15
# Difference of the hand-eye's length that is worth a note, metres. Chosen: below, other errors are
# as large.
_LEAST_LENGTH = 2e-3
# Standard error up to which a scale is looked at, and how many of them it must have. Chosen.
_LARGEST_ERROR, _SIGMAS = 0.005, 5.0


def check(look: Look) -> list[Finding]:
    """Judge errors of the distance in proportion to it that fit all frames."""
    given = look.as_given
    if given is None:
        return []
    if abs(given.slope) > _OTHER_UNIT:
        return [
            Finding(
                "scale",
                "impossible",
                f"All distances are {100 * given.slope:+.0f} % off against the poses: depth or "
                "poses are in another unit, or scaled.",
                spoils=True,
            )
        ]
    share, error = _measured(look)
    length = abs(share) * float(math.hypot(*given.hand_eye[:3, 3]))
    heads = abs(given.slope) > SLOPE
    if not heads and not (length > _LEAST_LENGTH and abs(share) > _SIGMAS * error):
        return []
    uncertain = f" (standard error {100 * error:.2g} %)" if error <= _LARGEST_ERROR else ""
    return [
        Finding(
            "scale",
            "ambiguous" if heads else "note",
            f"The camera's distances are {100 * abs(share):.1f} %{uncertain} "
            f"{'longer' if share > 0 else 'shorter'} than the robot's lengths, and this "
            "recording cannot tell which of them is right; if the camera's are, a fit makes the "
            f"hand-eye translation {1e3 * length:.1f} mm too {'short' if share > 0 else 'long'}.",
        )
    ]


def _measured(look: Look) -> tuple[float, float]:
    """Return the scale and its standard error; that of the alignment if nothing finer is known."""
    assert look.as_given is not None
    if look.scale is not None and look.scale.error <= _LARGEST_ERROR:
        return look.scale.share, look.scale.error
    return look.as_given.slope, math.inf
