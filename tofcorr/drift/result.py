"""What a drift check found, in words and as plain values."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

from tofcorr.digits import aligned, in_mm, known, known_interval
from tofcorr.drift.offset import ImageDrift, Wall
from tofcorr.plausibility.finding import in_words

if TYPE_CHECKING:  # Matplotlib takes longer to import than a check.
    from matplotlib.figure import Figure

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
        return "\n".join(self._sentences())

    def _sentences(self, *, table: bool = True) -> list[str]:
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
            *(aligned(found) if table else ()),
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
        return [line for line in lines if line]

    def plot(self) -> "Figure":
        """Draw the offset and how flat each image's wall is, against the threshold."""
        from tofcorr.pages.drawing import BLUE, FAINT, GREY, RED, line_across, panels

        limit, colour = 1e3 * self.threshold, RED if self.verdict == "drifted" else BLUE
        figure, (upper, lower) = panels(4, 2, shares=(1, 3))
        low, high = (1e3 * end for end in self.interval)
        upper.axvspan(-limit, limit, color=GREY, alpha=FAINT, linewidth=0)
        upper.plot([low, high], [0, 0], color=colour, linewidth=2)
        upper.plot(1e3 * self.offset, 0, "o", color=colour)
        line_across(upper, vertical=True)
        upper.set(yticks=[], xlabel="offset since the calibration, mm (positive: too far)")
        frames = [one.frame for one in self.images]
        lower.axhspan(0, limit, color=GREY, alpha=FAINT, linewidth=0)
        lower.plot(
            frames, [1e3 * one.flatness for one in self.images], "o", color=BLUE, markersize=4
        )
        lower.set(xlabel="frame", ylabel="departure from a plane, mm", ylim=(0, None))
        lower.locator_params(axis="x", integer=True)
        return figure

    def page(self, run: str, recordings: list[str]) -> str:
        """Return the same as one HTML page with a picture.

        Args:
            run: Name of the calibration.
            recordings: Names of the recordings.
        """
        from tofcorr.pages.page import page_text

        # The page has the numbers of the table in boxes.
        verdict, *others = self._sentences(table=False)
        values = {"run": run, "recordings": recordings, "headline_said": verdict}
        values |= {"others": others, **self.to_mapping()}
        figures, filters = {"drift": self.plot()}, {"mm": in_mm}
        return page_text("tofcorr.drift", "report.html.j2", figures, filters, **values)

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
