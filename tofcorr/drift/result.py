"""What a drift check found, in words, as plain values and as a figure."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from tofcorr.digits import known, known_interval
from tofcorr.drift.offset import Wall

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Verdict = Literal["holds", "drifted", "undecided"]

_VERDICTS = {
    "holds": "The calibration holds.",
    "drifted": "The camera has drifted: calibrate anew.",
    "undecided": "Undecided: these frames neither show a drift nor exclude one.",
}


class ImageDrift(NamedTuple):
    """One image of a drift check.

    Attributes:
        frame: Its number.
        offset: How much farther than at calibration the camera reads there, metres.
        flatness: Root mean square departure of its corrected wall from a plane, metres.
        num_pixels: Pixels used.
    """

    frame: int
    offset: float
    flatness: float
    num_pixels: int


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

    def __repr__(self) -> str:
        """Return the verdict and its numbers in a few sentences."""
        interval = 1e3 * self.interval[0], 1e3 * self.interval[1]
        offset = known(1e3 * self.offset, interval, most=2, sign="+")
        low, high = known_interval(interval, most=2, sign="+")
        lines = [
            *([self.headline] if self.headline else []),
            _VERDICTS[self.verdict],
            f"Its distances are {offset} mm off, compared with the calibration (positive: too far; "
            f"95 % interval {low} to {high} mm; threshold {1e3 * self.threshold:g} mm).",
            f"The corrected walls depart from planes by {1e3 * self.flatness:.2f} mm.",
        ]
        # Some are expected: the ranges are the central 99.8 % of the training pixels.
        if self.outside > 0.1:
            lines.append(
                f"{100 * self.outside:.0f} % of the pixels lie outside the calibrated ranges and "
                "were not used."
            )
        # Of views like the calibrated ones a twentieth counts as unlike.
        if self.unlike > 0.5:
            lines.append(
                f"{100 * self.unlike:.0f} % of the images see the wall as no calibrated one did "
                "(distance, tilt, place in the image): errors of such views were not measured, and "
                "the interval may be too narrow. Check at the views of the calibration."
            )
        if not self.form_is_known:
            lines.append(
                "The run has no reference.json (an older version trained it): the interval takes "
                "the form of its model as right, and is too narrow where that is wrong."
            )
        if self.verdict == "undecided":
            lines.append(self._what_to_do())
        return "\n".join(lines)

    def _what_to_do(self) -> str:
        """Return how to come to a decision."""
        if self.wall != "per_image":
            return "Add frames at different distances and tilts."
        half_width = 1e3 * (self.interval[1] - self.interval[0]) / 2
        return (
            "A wall at an unknown place in each image shows an offset only by the bow that this "
            f"gives to a plane, here to within {half_width:.2g} mm. Use a measured wall (wall: "
            "recorded), or one wall seen from known robot poses (wall: one)."
        )

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
            "images": [
                {
                    "frame": image.frame,
                    "flatness_mm": 1e3 * image.flatness,
                    "pixels": image.num_pixels,
                }
                for image in self.images
            ],
        }

    def plot_images(self) -> "Figure":
        """Draw offset and flatness of each image, with the overall interval and the threshold."""
        from matplotlib.figure import Figure

        figure, threshold = Figure(figsize=(7.0, 5.0), layout="constrained"), 1e3 * self.threshold
        top, bottom = figure.subplots(2, 1, sharex=True)
        frames = [image.frame for image in self.images]
        low, high = (1e3 * end for end in self.interval)
        top.axhspan(low, high, color="C0", alpha=0.2, label="all images, 95 % interval")
        offsets = [1e3 * image.offset for image in self.images]
        top.plot(frames, offsets, "o", color="C0", label="one image")
        bottom.plot(frames, [1e3 * image.flatness for image in self.images], "o", color="C1")
        for axes, ends in ((top, (-threshold, threshold)), (bottom, (threshold,))):
            for end in ends:
                axes.axhline(end, color="C3", linestyle="--", linewidth=1)
            axes.grid(alpha=0.25)
        top.set_ylabel("reads too far by [mm]")
        top.legend(fontsize=8)
        bottom.set_ylabel("departure from a plane [mm]")
        bottom.set_ylim(bottom=0.0)
        bottom.set_xlabel("frame (dashed: threshold)")
        return figure
