"""The checks run on a recording; `vet` is what every command calls first."""

from dataclasses import replace
from importlib import import_module
from pathlib import Path

from tofcorr.errors import CalibrationDataError
from tofcorr.pixels.dataset import Dataset, PlaneChoice, Recordings, opened, resolved_planes
from tofcorr.plausibility.checks.geometry import garbage_of, outlying_frames
from tofcorr.plausibility.finding import SEVERITIES, Finding, Inspection
from tofcorr.plausibility.look import Look, PlaneUse

OF_VALUES = (
    "checks.values:units",
    "checks.values:corrected",
    "checks.values:depth_values",
    "checks.values:stillness",
    "checks.values:repeats",
    "checks.values:duplicates",
    "checks.values:stamps",
    "checks.values:amplitude",
    "checks.values:temperatures",
    "checks.values:lens",
)
"""Checks that look at values alone, `module:function`, in the order in which they are made. What
they find impossible makes those below pointless."""

OF_GEOMETRY = (
    "checks.geometry:lone_walls",
    "checks.geometry:garbage",
    "checks.geometry:normals",
    "checks.geometry:shape",
    "checks.geometry:drift",
    "checks.geometry:late",
    "mounting:remounting",
    "checks.geometry:agreement",
    "checks.geometry:outlying_poses",
    "checks.values:two_cameras",
    "checks.values:exposure",
)
"""Checks that compare depth, poses, planes and camera."""


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
        from tofcorr.pages.page import refuse_page

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
        more = "`tofcorr inspect` shows more; --force, in Python force=True, goes on all the same."
        raise CalibrationDataError(f"{data.first.path}: {sentences} ({more})")
    return found


def examine(data: Dataset, planes: PlaneUse = "known", *, fits: bool = True) -> Inspection:
    """Run the checks in turn; those of geometry until one finds something impossible."""
    look = Look(data, planes, fits=fits)
    findings: list[Finding] = []
    aligned = impossible = False
    for place in (*OF_VALUES, *OF_GEOMETRY):
        if impossible and place in OF_GEOMETRY:
            break
        aligned = place in OF_GEOMETRY
        module, _, name = place.partition(":")
        check = getattr(import_module(f"tofcorr.plausibility.{module}"), name)
        findings += [replace(one, check=one.check or name.replace("_", " ")) for one in check(look)]
        impossible = any(one.severity == "impossible" for one in findings)
    share, bent, dominated = (0.0, False, False) if impossible else garbage_of(look)
    # Each sentence once. Sorting is stable: within a severity the order of the checks stays.
    once = {one.sentence: one for one in findings}.values()
    return Inspection(
        recordings=tuple(str(one.path) for one in data.recordings),
        findings=tuple(sorted(once, key=lambda one: SEVERITIES.index(one.severity))),
        numbers=look.numbers(aligned=aligned),
        outlying={} if impossible else outlying_frames(look),
        garbage_share=share,
        garbage_bends=bent or dominated,
        look=look,
    )
