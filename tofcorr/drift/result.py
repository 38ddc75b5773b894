"""What a drift check found, in words and as plain values."""

from dataclasses import dataclass
from typing import Any, Literal

from tofcorr.digits import aligned, known, known_interval
from tofcorr.drift.offset import ImageDrift, Wall
from tofcorr.plausibility.finding import in_words

Verdict = Literal["holds", "drifted", "undecided"]

_VERDICTS = {
    "holds": "The calibration holds.",
    "drifted": "The camera has drifted, if the wall is as --wall takes it: calibrate anew.",
    "undecided": "Undecided: these frames neither show a drift nor exclude one.",
}


@dataclass(frozen=True, repr=False)
class DriftResult:
    """Whether a calibration still holds; its `repr` is the sentences that the command prints.

    Attributes:
        verdict: `holds`: an offset beyond the threshold is excluded; `drifted`: an offset beyond
            it is certain, or the corrected wall is not flat; `undecided`: neither.
        wall: What was assumed of the wall.
        offset: How much farther than at calibration the camera reads, metres.
        interval: Its 95 % interval, metres.
        flatness: Root mean square departure of the corrected walls from planes, without the
            noise's share, metres.
        threshold: Offset or departure above which the camera counts as drifted, metres.
        images: The images used.
        outside: Share of the pixels outside the calibrated ranges, which were not used.
        form_is_known: Whether the run says how far its model's form may be wrong; otherwise the
            interval takes it as right.
        headline: What makes the frames doubtful, one sentence; None: nothing.
        unlike: Share of the images whose view of the wall is unlike any that was calibrated.
        unused: Numbers of the frames with too few usable pixels.
    """

    verdict: Verdict
    wall: Wall
    offset: float
    interval: tuple[float, float]
    flatness: float
    threshold: float
    images: list[ImageDrift]
    outside: float
    form_is_known: bool = True
    headline: str | None = None
    unlike: float = 0.0
    unused: tuple[int, ...] = ()

    def __repr__(self) -> str:
        """Return the verdict and its numbers in a few sentences."""
        interval = 1e3 * self.interval[0], 1e3 * self.interval[1]
        offset = known(1e3 * self.offset, interval, most=2, sign="+")
        low, high = known_interval(interval, most=2, sign="+")
        how = "Add frames at different distances and tilts."
        if self.wall == "per_image":
            bow = f"tells an offset to within {(interval[1] - interval[0]) / 2:.2g} mm"
            how = f"A wall at an unknown place {bow}. Use a measured one, or one seen from poses."
        limit = f"limit {1e3 * self.threshold:g} mm"
        found = (
            (
                "distances too far since then by",
                f"{offset} mm",
                f"95 %: {low} to {high} mm; {limit}",
            ),
            ("walls depart from planes by", f"{1e3 * self.flatness:.2f} mm", limit),
        )
        lines = [
            _VERDICTS[self.verdict],
            self.headline,
            *aligned(found),
            self.unused and f"Not used, with too few usable pixels: {in_words(self.unused)}.",
            # Some are expected: the ranges are the central 99.8 % of the training pixels.
            self.outside > 1 / 10
            and f"{100 * self.outside:.0f} % of the pixels, outside the ranges, were not used.",
            # Of views like the calibrated ones a twentieth counts as unlike.
            self.unlike > 1 / 2
            and f"{100 * self.unlike:.0f} % of the images see the wall as no calibrated one did: "
            "the interval may be too narrow. Check at the views of the calibration.",
            not self.form_is_known
            and "The run has no reference.json: the interval takes the form of its model as right.",
            self.verdict == "undecided" and how,
        ]
        return "\n".join(line for line in lines if line)

    @property
    def details(self) -> str:
        """The same, and how flat the corrected wall of each image is."""
        walls = (
            f"  frame {k}: {1e3 * off:.2f} mm, {count} pixels" for k, off, count in self.images
        )
        return "\n".join([repr(self), "Departure of each corrected wall from a plane:", *walls])

    def to_mapping(self) -> dict[str, Any]:
        """Return the finding as plain values, as in the command's JSON file."""
        return {
            "format": "tofcorr-check",
            "version": 1,
            "headline": self.headline,
            "verdict": self.verdict,
            "wall": self.wall,
            "offset_mm": 1e3 * self.offset,
            "offset_ci95_mm": [1e3 * end for end in self.interval],
            "threshold_mm": 1e3 * self.threshold,
            "flatness_mm": 1e3 * self.flatness,
            "outside_calibrated_range": self.outside,
            "unlike_calibrated_views": self.unlike,
            "unused_frames": list(self.unused),
            "images": [
                {"frame": frame, "flatness_mm": 1e3 * flatness, "pixels": pixels}
                for frame, flatness, pixels in self.images
            ],
        }
