"""`tofcorr check`: does a calibration still hold?"""

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click

if TYPE_CHECKING:
    from tofcorr.drift.drift import DriftCheck


@click.command(name="check", short_help="Say whether a calibration still holds.")
@click.option(
    "--run", required=True, type=click.Path(path_type=Path), help="Folder of the training's run."
)
@click.option(
    "--recording",
    "recordings",
    required=True,
    multiple=True,
    type=click.Path(path_type=Path),
    help="A few frames of any wall.",
)
@click.option(
    "--wall",
    type=click.Choice(["per_image", "one", "recorded"]),
    default="per_image",
    show_default=True,
    help="What is known of the wall: nothing; that all frames show the same one and the robot's "
    "poses are right; or its recorded plane.",
)
@click.option(
    "--threshold-mm", type=float, default=5.0, show_default=True, help="What counts as drift."
)
@click.option("--out", type=click.Path(path_type=Path), help="JSON file to write.")
def command(
    run: Path,
    recordings: tuple[Path, ...],
    wall: Literal["per_image", "one", "recorded"],
    threshold_mm: float,
    out: Path | None,
) -> None:
    """Re-measure a calibration on a few frames and say how far the camera has drifted.

    The answer is `holds`, `drifted` or `undecided`; the exit code is 0 in each case.
    """
    import json

    from tofcorr.correction.state import STATE_FILE, load_calibration
    from tofcorr.data.recording import Recording
    from tofcorr.drift.drift import check_drift
    from tofcorr.errors import CalibrationDataError, ConfigError
    from tofcorr.pixels.dataset import Dataset

    if threshold_mm <= 0:
        raise ConfigError(f"--threshold-mm: expected a positive number, got {threshold_mm:g}.")
    path = run / STATE_FILE
    if not path.is_file():
        raise CalibrationDataError(f"{path}: there is no such file; is {run} a run of tofcorr?")
    dataset = Dataset(tuple(Recording.open(one) for one in recordings))
    found = check_drift(load_calibration(path), dataset, wall, threshold_mm / 1e3)
    click.echo(_in_words(found))
    if out is not None:
        part = out.with_name(f".{out.name}.part")
        part.write_text(json.dumps(_mapping(found), indent=1, allow_nan=False) + "\n", "utf-8")
        part.replace(out)


def _in_words(found: "DriftCheck") -> str:
    low, high = (1e3 * end for end in found.interval)
    limit = 1e3 * found.threshold
    lines = [
        {
            "holds": "The calibration holds.",
            "drifted": "The camera has drifted: calibrate anew.",
            "undecided": "These frames do not tell.",
        }[found.verdict],
        f"It reads {1e3 * found.offset:+.2f} mm too far compared with the calibration "
        f"(95 % interval {low:+.2f} to {high:+.2f} mm; threshold {limit:g} mm).",
        f"The corrected walls depart from planes by {1e3 * found.flatness:.2f} mm.",
    ]
    if found.outside > 0.1:
        lines.append(
            f"{100 * found.outside:.0f} % of the pixels lie outside the calibrated ranges and were "
            "not used."
        )
    if found.verdict == "undecided":
        lines.append(
            "Add frames, at different distances and tilts; a robot's poses (--wall one) or a known "
            "wall (--wall recorded) tell much more than walls that stand anywhere."
        )
    return "\n".join(lines)


def _mapping(found: "DriftCheck") -> dict[str, Any]:
    return {
        "format": "tofcorr-check",
        "version": 1,
        "verdict": found.verdict,
        "wall": found.wall,
        "offset_mm": 1e3 * found.offset,
        "offset_ci95_mm": [1e3 * end for end in found.interval],
        "threshold_mm": 1e3 * found.threshold,
        "flatness_mm": 1e3 * found.flatness,
        "outside_calibrated_range": found.outside,
        "images": [
            {"frame": frame, "flatness_mm": 1e3 * departure, "pixels": pixels}
            for frame, departure, pixels in found.images
        ],
    }
