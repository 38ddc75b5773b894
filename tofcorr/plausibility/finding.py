"""What checks found: how bad it is, in a sentence each, and for the commands that ask for it."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:
    from tofcorr.plausibility.look import Look

Severity = Literal["impossible", "doubtful", "ambiguous", "note"]
"""`impossible`: any fit would be meaningless; `doubtful`: a fit may be wrong; `ambiguous`: two
causes look alike, and with one of them a fit is wrong; `note`: unusual."""

SEVERITIES: tuple[Severity, ...] = ("impossible", "doubtful", "ambiguous", "note")
"""From the worst to the mildest."""


@dataclass(frozen=True)
class Finding:
    """Something odd about a recording.

    Attributes:
        severity: How bad it is.
        sentence: What is odd, with a number, its likely cause, and what to do.
        frames: Global numbers of the frames concerned; empty: the recording as a whole.
        spoils: Whether the hand-eye of a fit would be wrong by more than its standard errors say.
        check: What it is named by; empty: by the check that found it.
    """

    severity: Severity
    sentence: str
    frames: tuple[int, ...] = ()
    spoils: bool = False
    check: str = ""

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {
            "check": self.check,
            "severity": self.severity,
            "sentence": self.sentence,
            "frames": list(self.frames),
        }


impossible, doubtful, note = (
    partial(Finding, severity) for severity in ("impossible", "doubtful", "note")
)


def in_words(frames: tuple[int, ...] | list[int], most: int = 5) -> str:
    """Return frame numbers as text: `frames 3, 4 and 7`, or `frames 3, 4, ... (12 in all)`."""
    names = [str(frame) for frame in frames]
    if len(names) == 1:
        return f"frame {names[0]}"
    if len(names) <= most:
        return f"frames {', '.join(names[:-1])} and {names[-1]}"
    return f"frames {', '.join(names[:most])}, ... ({len(names)} in all)"


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Inspection:
    """What is odd about a recording; its `repr` is what `tofcorr inspect` prints.

    Attributes:
        recordings: Names of the folders.
        findings: The worst first.
        numbers: What was measured, by name with its unit; only what could be.
        outlying: Misfit of the frames that disagree with all others, metres, by global number.
        garbage_share: Share of the pixels far off the plane of their frame.
        garbage_bends: Whether they are so many, or so far off, that they bend or dominate a fit.
        look: The sample, the frames' planes and their alignment, for the page.
    """

    recordings: tuple[str, ...]
    findings: tuple[Finding, ...]
    numbers: Mapping[str, float]
    outlying: Mapping[int, float] = field(default_factory=dict)
    garbage_share: float = 0.0
    garbage_bends: bool = False
    look: "Look"

    @property
    def impossible(self) -> tuple[Finding, ...]:
        """The findings with which any fit would be meaningless."""
        return tuple(one for one in self.findings if one.severity == "impossible")

    @property
    def notes(self) -> tuple[str, ...]:
        """What is unusual and no reason to doubt the recording, one sentence each."""
        return tuple(one.sentence for one in self.findings if one.severity == "note")

    @property
    def headline(self) -> str | None:
        """The worst finding in one sentence, to stand before any number; None: only notes."""
        serious = [one for one in self.findings if one.severity != "note"]
        if not serious:
            return None
        more = len(serious) - 1
        rest = f" ({more} more: tofcorr inspect)" if more else ""
        kind = "Ambiguous" if serious[0].severity == "ambiguous" else "Doubtful"
        return f"{kind} recording: {serious[0].sentence}{rest}"

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {
            "recordings": list(self.recordings),
            "findings": [one.to_mapping() for one in self.findings],
            "numbers": dict(self.numbers),
            "outlying_frames": {str(k): 1e3 * value for k, value in self.outlying.items()},
            "garbage_share": self.garbage_share,
        }

    def __repr__(self) -> str:
        """Return the findings, the worst first, and what was measured."""
        found = sorted(self.findings, key=lambda one: SEVERITIES.index(one.severity))
        lines = [f"{one.severity:<11}{one.sentence}" for one in found]
        numbers = [f"  {name:<44}{value:>10.4g}" for name, value in self.numbers.items()]
        said = lines or ["Nothing odd was found."]
        return "\n".join([", ".join(self.recordings), *said, *numbers])
