"""Pose files of all formats: one line a format."""

from collections.abc import Callable, Mapping
from pathlib import Path

from tofcorr.errors import CalibrationDataError, ConfigError
from tofcorr.importing.poses.header import header_of
from tofcorr.importing.poses.matrices import read_matrices
from tofcorr.importing.poses.moveit import read_moveit
from tofcorr.importing.poses.table import read_table
from tofcorr.importing.poses.text import lines_of, read_text
from tofcorr.importing.poses.track import PoseTrack
from tofcorr.importing.poses.tum import read_tum

POSE_FORMATS: Mapping[str, Callable[[Path], PoseTrack]] = {
    "tum": read_tum,
    "csv": read_table,
    "matrices": read_matrices,
    "moveit": read_moveit,
}
"""How each format is read; `matrix` is understood as `matrices`."""


def read_poses(path: Path, pose_format: str | None = None) -> PoseTrack:
    """Read a pose file.

    Args:
        path: The file, or a folder with one matrix a file.
        pose_format: One of `POSE_FORMATS`; None: told from the content.

    Raises:
        CalibrationDataError: The file is missing or not of that format.
        ConfigError: There is no such format.
    """
    if not path.exists():
        raise CalibrationDataError(f"{path}: there is no such pose file.")
    name = "matrices" if pose_format == "matrix" else pose_format
    if name is None:
        name = guess_format(path)
    if name not in POSE_FORMATS:
        known = ", ".join(POSE_FORMATS)
        raise ConfigError(f"There is no pose format '{name}'. Known: {known}.")
    return POSE_FORMATS[name](path)


def guess_format(path: Path) -> str:
    """Tell the format of a pose file from its name and its first line.

    Raises:
        CalibrationDataError: It is of no format known.
    """
    if path.is_dir() or path.suffix.lower() == ".npy":
        return "matrices"
    if path.suffix.lower() in (".yaml", ".yml"):
        return "moveit"
    text = read_text(path)
    if text.lstrip()[:1] in ("{", "["):
        raise CalibrationDataError(
            f"{path}: poses are not read from JSON. Write them as CSV with a header row, as TUM's "
            "lines, or as matrices, 16 numbers a line."
        )
    if header_of(text) is not None:
        return "csv"
    lines = lines_of(text)
    if not lines:
        raise CalibrationDataError(f"{path}: expected poses, found none.")
    counts = {8: "tum"} | dict.fromkeys((4, 12, 13, 16, 17), "matrices")
    count = len(lines[0].fields)
    if count not in counts:
        raise CalibrationDataError(
            f"{path}: the format is not recognised: {count} numbers in line {lines[0].number}. "
            "Expected 8 (TUM: time, translation, quaternion x y z w), 12 or 16 (a matrix), or a "
            "header row (CSV). Say which with --pose-format."
        )
    return counts[count]
