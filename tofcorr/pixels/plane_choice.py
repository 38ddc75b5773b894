"""Whether the recorded planes are used as they are, or are a start for the fit."""

from collections.abc import Iterable
from typing import Literal

from tofcorr.data.recording import Recording

PlaneChoice = Literal["auto", "known", "unknown"]
"""`known`: recorded planes are right; `unknown`: they are a start; `auto`: as `recording.yaml` says
(`planes: estimated` is unknown)."""


def resolved_planes(
    choice: PlaneChoice, recordings: Iterable[Recording]
) -> Literal["known", "unknown"]:
    """Return whether the planes are known: for `auto`, if those of every recording were measured.

    Args:
        choice: What the options say.
        recordings: The recordings that are fitted together.
    """
    if choice != "auto":
        return choice
    return "unknown" if any(one.planes == "estimated" for one in recordings) else "known"
