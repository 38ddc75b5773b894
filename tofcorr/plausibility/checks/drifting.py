"""Do poses, wall and camera agree as well at the end of a recording as at its beginning?"""

from tofcorr.plausibility.finding import Finding
from tofcorr.plausibility.look import Look

# Drift that makes a fit meaningless, metres. Chosen: frames then miss their planes by 25 mm in the
# middle, as much as in `agreement`.
_MEANINGLESS = 0.1


def check(look: Look) -> list[Finding]:
    """Judge the drift from the first frame to the last."""
    drift = look.drift
    if drift is None or not drift.counts:
        return []
    return [
        Finding(
            "drift",
            "impossible" if drift.size > _MEANINGLESS else "doubtful",
            f"From the first frame to the last the points move {1e3 * drift.size:.0f} mm off the "
            f"recorded planes (standard error {1e3 * drift.error:.0f} mm): the poses drift, or "
            "robot, target or camera was moved while recording; record again, or in parts.",
        )
    ]
