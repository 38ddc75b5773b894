"""Does the camera sit at one place on the tool throughout?"""

from tofcorr.plausibility.finding import Finding
from tofcorr.plausibility.look import Look


def check(look: Look) -> list[Finding]:
    """Judge the step of the camera on the tool, unless poses drift."""
    step, drift = look.step, look.drift
    if step is None or not step.counts or (drift is not None and drift.counts):
        return []
    first = int(look.frames[look.scene.known][step.frame])
    return [
        Finding(
            "remounting",
            "doubtful",
            f"From frame {first} on, or about there, the points lie {1e3 * step.size:.0f} mm "
            "elsewhere, as if the camera had moved on the tool (two hand-eye transforms explain "
            f"{100 * step.share:.0f} % of what one leaves): it was knocked or mounted anew, or "
            "poses and images are of different times; train the parts apart.",
            spoils=True,
        )
    ]
