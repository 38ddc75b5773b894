"""The checks run on a recording; `vet` is what every command calls first."""

import math
from pathlib import Path

import numpy as np

from tofcorr.errors import CalibrationDataError
from tofcorr.pixels.dataset import Dataset, PlaneChoice, Recordings, opened, resolved_planes
from tofcorr.plausibility.checks.garbage import bends, dominates, garbage_share
from tofcorr.plausibility.checks.outlying_poses import outlying_frames
from tofcorr.plausibility.finding import SEVERITIES, Finding
from tofcorr.plausibility.inspection import Inspection
from tofcorr.plausibility.look import Look, PlaneUse
from tofcorr.plausibility.registry import OF_GEOMETRY, OF_VALUES
from tofcorr.plausibility.sample import read_sample

# Standard error of the focal length's change up to which it is shown. Chosen.
_FOCAL_SE = 0.03


def inspect(
    recordings: Recordings, *, planes: PlaneChoice = "auto", out: str | Path | None = None
) -> Inspection:
    """Look at recordings as an experienced user would, and say what is odd.

    A few pixels of each frame are read. Nothing is fitted but one alignment of the camera.

    Args:
        recordings: A folder, a `Recording`, or several of either, of one camera.
        planes: Whether the recorded planes are taken as measured (`known`), as a start (`unknown`),
            or as recording.yaml says (`auto`).
        out: HTML page with pictures to write; None writes nothing.

    Returns:
        The findings; printed, they are what the command prints.

    Raises:
        CalibrationDataError: A folder holds no recording, recordings are of several cameras, or
            `out` does not end in .html, exists or cannot be written.
    """
    if out is not None:
        from tofcorr.plausibility.page import refuse_page

        refuse_page(Path(out))
    data = Dataset(opened(recordings))
    found = examine(data, resolved_planes(planes, data.recordings))
    if out is not None:
        from tofcorr.plausibility.page import write_page

        write_page(found, Path(out))
    return found


def vet(
    data: Dataset, planes: PlaneUse = "known", *, fits: bool = True, force: bool = False
) -> Inspection:
    """Return the inspection of recordings, unless any fit to them would be meaningless.

    Args:
        data: The recordings.
        planes: What the caller does with the recorded planes.
        fits: Whether it fits a model to the recordings.
        force: Whether to go on whatever is found.

    Raises:
        CalibrationDataError: A finding is `impossible`, and `force` is not set.
    """
    found = examine(data, planes, fits=fits)
    if found.impossible and not force:
        sentences = " ".join(one.sentence for one in found.impossible)
        raise CalibrationDataError(
            f"{data.first.path}: {sentences} (`tofcorr inspect` shows more; --force, in Python "
            "force=True, goes on all the same.)"
        )
    return found


def examine(data: Dataset, planes: PlaneUse = "known", *, fits: bool = True) -> Inspection:
    """Run the checks in turn; those of geometry until one finds something impossible."""
    look = Look(read_sample(data), planes, fits)
    findings = [one for check in OF_VALUES for one in check(look)]
    sound = not any(one.severity == "impossible" for one in findings)
    for check in OF_GEOMETRY if sound else ():
        findings += check(look)
        if any(one.severity == "impossible" for one in findings):
            break
    # Sorting is stable: within a severity the order of the checks stays.
    findings.sort(key=lambda one: SEVERITIES.index(one.severity))
    aligned = sound and not any(one.severity == "impossible" for one in findings)
    return Inspection(
        recordings=tuple(str(one.path) for one in data.recordings),
        findings=tuple(_without_repeats(findings)),
        numbers=_numbers(look, aligned=sound),
        outlying=outlying_frames(look) if aligned else {},
        garbage_share=garbage_share(look) if aligned else 0.0,
        garbage_bends=aligned and (bends(look) or dominates(look)),
        look=look,
    )


def _without_repeats(findings: list[Finding]) -> list[Finding]:
    """Return the findings with each check's sentence once."""
    return list({one.sentence: one for one in findings}.values())


def _numbers(look: Look, *, aligned: bool) -> dict[str, float]:
    sample = look.sample
    values = sample.stored[np.isfinite(sample.stored)]
    poses = np.asarray(sample.column("world_from_tool"))
    place = poses[:, :3, 3]
    found: dict[str, float] = {
        "frames": float(sample.data.num_frames),
        "median distance, m": float(np.median(values)) if len(values) else math.nan,
        "extent of the poses, m": float(np.linalg.norm(np.ptp(place, axis=0))),
        "pixels on the target, %": 100 * float(sample.masked.mean()),
        "noise of a pixel, mm": 1e3 * sample.noise,
    }
    if aligned:
        found["flatness of a frame's points, mm"] = 1e3 * look.flatness
        given = look.as_given
        if given is not None:
            found["distance to the planes after alignment, mm"] = 1e3 * given.misfit
            found["angle to the planes after alignment, deg"] = math.degrees(given.typical_angle)
            found["distances too long by, mm"] = 1e3 * given.constant
        if look.shape is not None and look.shape.focal.size_error < _FOCAL_SE:
            found["focal length should change by, %"] = 100 * float(look.shape.focal.value[0])
            found["standard error of that change, %"] = 100 * look.shape.focal.size_error
    return {name: value for name, value in found.items() if math.isfinite(value)}
