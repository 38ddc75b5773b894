"""What checks found: how bad it is, in a sentence each, and for the commands that ask for it."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any, Literal

from tofcorr.digits import aligned, at_most

if TYPE_CHECKING:
    from tofcorr.plausibility.look import Look

Severity = Literal["impossible", "doubtful", "ambiguous", "note"]
"""`impossible`: any fit would be meaningless; `doubtful`: a fit may be wrong; `ambiguous`: two
causes look alike, and with one of them a fit is wrong; `note`: unusual."""

SEVERITIES: tuple[Severity, ...] = ("impossible", "doubtful", "ambiguous", "note")
"""From the worst to the mildest."""

CAMERA = 0.02
"""How far errors of a camera put points off a plane at most, metres. Chosen: they are centimetres.
A fit to frames that are farther off is wrong by more than it is to correct: it is meaningless."""
HOPELESS = 0.05
"""Misfit of a frame from which no wall is seen, no alignment believed, or no calibration used,
metres. Chosen."""
FAR_OFF = 5 * CAMERA
"""Distance along the ray from its plane from which a pixel is garbage or wrapped, metres."""
LARGEST_GAP = 10 * CAMERA
"""Error of the distances that no camera has, metres: every effect of the catalogue together makes
less at the range of a depth camera; geometry that is wrong makes more."""
SPOILS = 0.008
"""Misfit that moves the hand-eye by more than its standard errors say, metres. Chosen."""
LARGE_CONSTANT = 0.15
"""Constant error of the distance that is large for a camera, metres. Chosen: cameras leave the
factory within a few centimetres."""
ODD_SLOPE = 0.025
"""Error in proportion to the distance from which on the usual mistakes are tried and which heads a
report. A recording shows only by how much camera and robot differ. One rule for both: the lengths
of the robot (without one, of the planes) count as true, what 1 % of them would change stands beside
the standard errors (`assumptions` of the report), and a larger difference heads the report.
Chosen: clocks are right to a percent, robots to a few tenths, and of 60 drawn cameras the circular
error of one made 2.0 %."""
SIGMAS = 5
"""An estimate counts from so many of its standard errors on. Chosen: of 560 estimates in 62 clean
recordings none reached four."""

WORTH_A_WORD = 1e-3
"""Shift of a camera, or root mean square change of points, that is reported, metres: no error of a
usual camera makes less of a difference. Chosen."""
MANY_FRAMES = 20
"""Frames that determine twice the unknowns of camera and errors, some thirty: three a frame.
Chosen."""
FEWEST_PIXELS = 50
"""Pixels by which a distribution, or an image of a wall, is judged. Chosen: a wall has three
unknowns."""


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
        # Those who fit look at `spoils`.
        return {name: value for name, value in asdict(self).items() if name != "spoils"}


impossible, doubtful, note = (
    partial(Finding, severity) for severity in ("impossible", "doubtful", "note")
)


def in_words(frames: tuple[int, ...] | list[int], most: int = 5) -> str:
    """Return frame numbers as text: `frames 3, 4 and 7`, or `frames 3, 4, ... (12 in all)`."""
    names = [str(frame) for frame in frames]
    if len(names) < 2:
        return f"frame {''.join(names) or 'none'}"
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
        rest = f" ({len(serious) - 1} more: tofcorr inspect)" if serious[1:] else ""
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
        """Return the worst findings, and what was measured first: 11 lines at most."""
        found = at_most(5, self._found)
        return "\n".join([*self._verdict, *found, *self._measured[: 10 - len(found)]])

    @property
    def details(self) -> str:
        """All findings, the worst first, and all that was measured."""
        return "\n".join([*self._verdict, *self._found, *self._measured])

    @property
    def _verdict(self) -> list[str]:
        worst = self.findings[0].severity if self.findings else ""
        said = {"": "Nothing odd was found.", "impossible": "No fit to this would mean anything."}
        named = ", ".join(self.recordings)
        return [f"{said.get(worst, f'{worst.capitalize()}: see below.')} Recording: {named}"]

    @property
    def _found(self) -> list[str]:
        return [f"{one.severity:<11}{one.sentence}" for one in self.findings]

    @property
    def _measured(self) -> list[str]:
        return aligned((f"  {name}", f"{value:.3g}") for name, value in self.numbers.items())
