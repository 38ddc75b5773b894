"""`tofcorr.check`: whether a calibration still holds, from a few frames of any wall."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np

from tofcorr.correction.state import STATE_FILE, CalibrationState, load_calibration
from tofcorr.drift.offset import OffsetSums, Wall
from tofcorr.drift.result import DriftResult, Verdict
from tofcorr.errors import CalibrationDataError, ConfigError
from tofcorr.estimation.linear import solvable
from tofcorr.files import file_to_replace, write_json, write_text
from tofcorr.fit.reference import (
    REFERENCE_FILE,
    Reference,
    load_reference,
    share_unlike,
    unknown_reference,
)
from tofcorr.pages.page import refuse_page
from tofcorr.pixels.dataset import Dataset, Recordings, opened
from tofcorr.plausibility.examine import vet
from tofcorr.plausibility.finding import CAMERA, FEWEST_PIXELS, LARGEST_GAP
from tofcorr.progress import through

# Why the equations of a check may have no solution, and what to do.
_NO_SOLUTION = "poses, planes or depth are off, or frames hardly differ; use --wall per_image."


def check(
    run: str | Path,
    recordings: Recordings,
    *,
    wall: Wall = "per_image",
    threshold_mm: float = 5.0,
    out: str | Path | None = None,
    page: str | Path | None = None,
    force: bool = False,
) -> DriftResult:
    """Measure a calibration again on a few frames of a wall.

    Args:
        run: Folder of the training's run.
        recordings: A folder, an opened recording, or a sequence of either: the new frames, of the
            same camera.
        wall: `recorded`: planes and robot poses are right; `one`: all images show one wall at an
            unknown place, the robot poses are right; `per_image`: nothing is known.
        threshold_mm: Offset, or departure of a corrected wall from a plane, above which the camera
            counts as drifted, millimetres.
        out: JSON file for the numbers; None writes nothing.
        page: HTML page with pictures to write, a new name; None writes none.
        force: Measure whatever the frames look like.

    Raises:
        ConfigError: The threshold is not positive.
        CalibrationDataError: `run` is not a run; the camera is another one; no image has enough
            usable pixels; the frames cannot be what they say (see `tofcorr.inspect`); `one` is
            asked for and no robot moves or there are several estimated walls; `recorded` is asked
            for and the planes are estimated; the offset is one that no camera has; or `out` or
            `page` cannot be written.
    """
    if threshold_mm <= 0:
        raise ConfigError(f"threshold_mm: expected a positive number, got {threshold_mm:g}.")
    if out is not None:
        file_to_replace(Path(out), CalibrationDataError)
    if page is not None:
        refuse_page(Path(page))
    state = load_calibration(Path(run) / STATE_FILE)
    dataset = Dataset(opened(recordings)).without_stray_light(state.scene.stray_light)
    dataset = dataset.without_second_bounces(state)
    _refuse_unfit(state, dataset, "per_image")
    planes = "known" if wall == "recorded" and not dataset.planes_are_estimated else "ignored"
    headline = vet(dataset, planes, fits=False, force=force).headline
    reference = load_reference(Path(run) / REFERENCE_FILE, state)
    with solvable(dataset.first.path, "check", _NO_SOLUTION):
        result = check_drift(state, dataset, wall, threshold_mm / 1e3, reference)
    low, high = result.interval
    # A certain drift is refused if it is most likely beyond what any camera has.
    if abs(result.offset) > LARGEST_GAP and not low <= 0 <= high and not force:
        said = f"distances would be {1e3 * result.offset:+.0f} mm off, and no camera drifts so far"
        advice = "check unit and kind of the depth, the mask and the wall, or add --force"
        raise CalibrationDataError(f"{dataset.first.path}: {said}: {advice} (Python: force=True).")
    result = replace(result, headline=headline or result.headline)
    if out is not None:
        write_json(Path(out), result.to_mapping())
    if page is not None:
        names = [recording.path.name for recording in dataset.recordings]
        write_text(page, result.page(Path(run).name, names), CalibrationDataError)
    return result


def check_drift(
    state: CalibrationState,
    dataset: Dataset,
    wall: Wall = "per_image",
    threshold: float = 5e-3,
    reference: Reference | None = None,
) -> DriftResult:
    """Measure how far a camera reads from what it read when it was calibrated.

    Pixels off the wall or outside the calibrated ranges are left out.

    Args:
        state: The calibration.
        dataset: The new frames, of the same camera.
        wall: What is known of the wall, as for `check`.
        threshold: Offset or departure from a plane that counts as drift, metres.
        reference: What the calibration's frames say of its form and of the robot's poses; None:
            the frames of the check must say it, and the form counts as right.

    Raises:
        CalibrationDataError: The camera is another one, no image has enough usable pixels, or one
            wall is asked for and no robot moves.
    """
    _refuse_unfit(state, dataset, wall)
    known = reference or unknown_reference(state, wall_is_known=wall == "recorded")
    if not dataset.has_amplitude:
        known = known.model_copy(update={"noise": None})
    sums = OffsetSums(state, dataset, wall, known)
    used = list(through(sums.read(), "checking", total=dataset.num_frames))
    if not used:
        said = f"no image has {FEWEST_PIXELS} usable pixels on a wall within the calibrated ranges"
        advice = "record a wall at these distances and amplitudes, in the same units"
        raise CalibrationDataError(f"{dataset.first.path}: {said}; {advice}.")
    offset, half_width, disagreement = sums.estimate()
    low, high = offset - half_width, offset + half_width
    flatness = math.sqrt(np.mean([one.flatness**2 for one in sums.images]))
    verdict: Verdict = "holds" if max(-low, high) <= threshold else "undecided"
    if max(low, -high, flatness) > threshold:
        verdict = "drifted"
    return DriftResult(
        verdict=verdict,
        wall=wall,
        offset=offset,
        interval=(low, high),
        flatness=flatness,
        threshold=threshold,
        images=sums.images,
        outside=1 - sums.calibrated / max(sums.on_wall, 1),
        form_is_known=reference is not None,
        unlike=0.0 if known.views is None else share_unlike(sums.sums.views, known.views),
        unused=tuple(np.setdiff1d(np.arange(dataset.num_frames), used).tolist()),
        headline=_headline(offset, half_width, disagreement),
    )


def _headline(offset: float, half_width: float, disagreement: float | None) -> str | None:
    """Return what to say first of images that are not of one camera and one wall, or not of it."""
    if disagreement is not None:
        much = f"{disagreement:.1f} times as much as those of the calibration"
        return f"Doubtful frames: they disagree {much}: two cameras, bent walls, or wrong poses?"
    # Warming up makes as much as other errors of a camera.
    if abs(offset) <= max(CAMERA, half_width):
        return None
    off = f"{1e3 * abs(offset):.0f} mm too {'far' if offset > 0 else 'near'}"
    return f"Doubtful frames: they are {off}, and cameras drift by millimetres: another setting?"


def _refuse_unfit(state: CalibrationState, dataset: Dataset, wall: Wall) -> None:
    """Refuse frames of another camera, or that cannot show what is asked of their walls."""
    first, walls = dataset.first, np.unique(dataset.targets)
    reason = None
    if first.camera != state.camera or first.depth_kind != state.depth_kind:
        size = f"{state.camera.width}x{state.camera.height} pixels, {state.depth_kind} depth"
        reason = f"this is not the camera that was calibrated: expected {size}, the same lens."
    elif wall == "one" and not dataset.moves:
        reason = "one wall needs a robot that moves, and no pose changes; use the wall per image."
    elif wall == "recorded" and dataset.planes_are_estimated:
        reason = "the planes are estimated from the depth; use the wall per image, or one wall."
    elif wall == "one" and dataset.planes_are_estimated and len(walls) > 1:
        shown = f"the frames show {len(walls)} ({', '.join(walls)})"
        reason = f"one wall is asked for, and {shown}; use the wall per image."
    if reason is not None:
        raise CalibrationDataError(f"{first.path}: {reason}")
