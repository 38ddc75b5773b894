"""What an inspection found, for people and for the commands that ask for it."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from tofcorr.plausibility.finding import SEVERITIES, Finding
from tofcorr.plausibility.look import Look


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
    look: Look

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
        lines = [", ".join(self.recordings)]
        if not self.findings:
            lines.append("Nothing odd was found.")
        for severity in SEVERITIES:
            lines += [
                f"{severity:<11}{one.sentence}" for one in self.findings if one.severity == severity
            ]
        return "\n".join([*lines, *(f"  {k:<44}{v:>10.4g}" for k, v in self.numbers.items())])
