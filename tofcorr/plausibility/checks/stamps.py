"""Do the timestamps count up?"""

import numpy as np

from tofcorr.plausibility.finding import Finding
from tofcorr.plausibility.look import Look


def check(look: Look) -> list[Finding]:
    """Look at the steps from frame to frame, in each recording."""
    found: list[Finding] = []
    start = 0
    for recording in look.sample.data.recordings:
        stamps = recording.frames.timestamp
        steps = np.diff(stamps)
        back = np.flatnonzero(steps < 0)
        if len(back):
            found.append(
                Finding(
                    "stamps",
                    "doubtful",
                    f"timestamp_s goes back {len(back)} times, first at frame "
                    f"{start + back[0] + 1}: the rows are not in the order of time; check that "
                    "images and poses are paired, and sort them.",
                    tuple((start + back + 1).tolist()),
                )
            )
        elif len(stamps) > 2 and not steps.any():
            found.append(
                Finding(
                    "stamps",
                    "note",
                    "timestamp_s is the same in all frames: nothing can be said of warm-up.",
                )
            )
        start += recording.num_frames
    return found
