"""What a check found: how bad it is, and one sentence about it."""

from dataclasses import dataclass
from typing import Any, Literal

Severity = Literal["impossible", "doubtful", "ambiguous", "note"]
"""`impossible`: any fit would be meaningless; `doubtful`: a fit may be wrong; `ambiguous`: two
causes look alike, and with one of them a fit is wrong; `note`: unusual."""

SEVERITIES: tuple[Severity, ...] = ("impossible", "doubtful", "ambiguous", "note")
"""From the worst to the mildest."""


@dataclass(frozen=True)
class Finding:
    """Something odd about a recording.

    Attributes:
        check: Name of the check that found it.
        severity: How bad it is.
        sentence: What is odd, with a number, its likely cause, and what to do.
        frames: Global numbers of the frames concerned; empty: the recording as a whole.
        spoils: Whether the hand-eye of a fit would be wrong by more than its standard errors say.
    """

    check: str
    severity: Severity
    sentence: str
    frames: tuple[int, ...] = ()
    spoils: bool = False

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {
            "check": self.check,
            "severity": self.severity,
            "sentence": self.sentence,
            "frames": list(self.frames),
        }


def in_words(frames: tuple[int, ...] | list[int], most: int = 5) -> str:
    """Return frame numbers as text: `frames 3, 4 and 7`, or `frames 3, 4, ... (12 in all)`."""
    names = [str(frame) for frame in frames]
    if len(names) == 1:
        return f"frame {names[0]}"
    if len(names) <= most:
        return f"frames {', '.join(names[:-1])} and {names[-1]}"
    return f"frames {', '.join(names[:most])}, ... ({len(names)} in all)"
