"""Distances and poses of a sensor of one or a few zones before one or several walls."""

import math
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from tofcorr.errors import CalibrationDataError, ConfigError
from tofcorr.importing.images import DepthImage
from tofcorr.importing.intrinsics import GivenIntrinsics, intrinsics_from_numbers
from tofcorr.importing.numbers import Line, any_numbers, lines_of, read_text
from tofcorr.importing.pose_files import read_poses
from tofcorr.importing.pose_track import PoseTrack
from tofcorr.importing.robot_images import RobotImages
from tofcorr.importing.run import RefusedViewError

_FILES = {"distances": "measurements.csv", "poses": "transforms.csv"}
"""What a folder holds."""


def zones_of(text: str) -> tuple[int, int]:
    """Read columns and rows, such as `8x8`.

    Most sensors have 8 zones a side (VL53L5CX); those of more than 64 give images, not tables.

    Raises:
        ConfigError: The text is something else.
    """
    match = re.fullmatch(r"(\d+)x(\d+)", text.strip().lower())
    if match is None or not all(1 <= int(part) <= 64 for part in match.groups()):
        raise ConfigError(f"--zones must be COLUMNSxROWS, such as 1x1 or 8x8, got '{text[:40]}'.")
    return int(match[1]), int(match[2])


def sensor_lens(
    zones: tuple[int, int], field_of_view_deg: tuple[float, ...] | None
) -> GivenIntrinsics:
    """Return the intrinsics of a pinhole camera with one pixel a zone.

    Args:
        zones: Columns and rows.
        field_of_view_deg: Of all zones together, horizontally and vertically (one number: both),
            degrees; not needed for one pixel, whose ray is the optical axis.

    Raises:
        ConfigError: A field of view is missing, or not between 0 and 180 degrees.
    """
    columns, rows = zones
    focal = [1.0, 1.0]
    if zones != (1, 1):
        if field_of_view_deg is None:
            raise ConfigError(f"A sensor of {columns}x{rows} zones needs --fov-deg H,V.")
        if not all(0 < angle < 180 for angle in field_of_view_deg):
            raise ConfigError(f"--fov-deg must be between 0 and 180, got {field_of_view_deg}.")
        angles = field_of_view_deg[0], field_of_view_deg[-1]
        pairs = zip(zones, angles, strict=True)
        focal = [side / 2 / math.tan(math.radians(angle) / 2) for side, angle in pairs]
    centre = (columns - 1) / 2, (rows - 1) / 2
    return replace(intrinsics_from_numbers(focal, centre, (), "--fov-deg"), size=zones)


def open_distances(
    sources: Sequence[Path],
    zones: tuple[int, int],
    lens: GivenIntrinsics,
    *,
    poses: Sequence[Path] = (),
    pose_format: str | None = None,
    names: Sequence[str] = (),
    unit_mm: float | None = None,
) -> RobotImages:
    """Read distances before one or several walls, as images of a few pixels.

    Args:
        sources: For each wall a file of distances, or a folder with one and a file of poses.
        zones: Columns and rows of the sensor.
        lens: Its zones as pixels.
        poses: For each wall a file of poses; none where folders hold them.
        pose_format: Of `tofcorr.importing.pose_files.POSE_FORMATS`; None: told from the content.
        names: What each wall is called; none: as its file or folder.
        unit_mm: Millimetres per count; None: inferred.

    Raises:
        CalibrationDataError: A file is missing or damaged, or rows and poses are not as many.
        ConfigError: There are not as many poses or names as sources.
    """
    names = _wall_names(sources, poses, names)
    tables = [read_distances(_file_in(source, "distances"), zones) for source in sources]
    paths = poses or [_file_in(source, "poses") for source in sources]
    tracks = [read_poses(path, pose_format).world_from_tool for path in paths]
    for path, track, (table, _) in zip(paths, tracks, tables, strict=True):
        if len(track) != len(table):
            raise CalibrationDataError(f"{path}: {len(track)} poses beside {len(table)} rows.")
    readings, scatter = (np.concatenate(part) for part in zip(*tables, strict=True))
    warnings: list[str] = []
    typical = float(np.nanmedian(readings))
    # No such sensor sees 20 m.
    unit = unit_mm or (1.0 if typical >= 20 else 1000.0)
    if unit_mm is None:
        word = "millimetres" if unit == 1 else "metres"
        read_as = f"Distances are typically {typical:g} and read as {word}"
        warnings.append(f"{read_as}; state --depth-unit-mm {unit:g} if that is right.")
    if zones == (1, 1):
        warnings.append("One pixel: its ray is the optical axis; a turn about it cannot be found.")
    origin = ", ".join(map(str, sources)) if len(sources) < 3 else f"{sources[0]}, ..."
    every = (unit * readings / 1000).astype(np.float32)

    def read(number: int) -> DepthImage:
        if not np.isfinite(every[number]).any():
            raise RefusedViewError("no zone has a return")
        return DepthImage(every[number])

    targets = np.repeat(names, [len(table) for table, _ in tables])
    rows = np.concatenate([np.arange(len(table)) for table, _ in tables])
    usual, most = unit * float(np.median(scatter)), unit * float(scatter.max())
    if most > max(20, 10 * usual):  # More than errors of a sensor, and no noise.
        said = (
            f"The readings of row {rows[scatter.argmax()]} of {targets[scatter.argmax()]} scatter"
        )
        warnings.append(f"{said} by {most:.0f} mm, of most by {usual:.0f} mm: leave it out.")
    return RobotImages(
        origin=origin,
        names=[f"{name} {row}" for name, row in zip(targets, rows, strict=True)],
        intrinsics=lens,
        read=read,
        track=PoseTrack.checked(np.concatenate(tracks), origin),
        targets=targets,
        warnings=warnings,
    )


def _wall_names(
    sources: Sequence[Path], poses: Sequence[Path], names: Sequence[str]
) -> Sequence[str]:
    for what, given in (("--poses", poses), ("--wall", names)):
        if given and len(given) != len(sources):
            raise ConfigError(f"expected one {what} per source ({len(sources)}), got {len(given)}.")
    names = [*names] or [source.stem for source in sources]
    if len(set(names)) < len(names):
        raise ConfigError(f"Two walls have one name: {', '.join(names)}. Name them with --wall.")
    return names


def _file_in(source: Path, what: str) -> Path:
    """Return the file itself, or the one of distances or poses in a folder."""
    if source.is_dir():
        return source / _FILES[what]
    if what == "poses":
        raise ConfigError(f"{source} is a file: name its poses with --poses.")
    return source


def read_distances(path: Path, zones: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Read a table of distances: one row a pose, one or several readings a row.

    A row holds, after an optional time stamp, the distances of all zones row by row, once or
    several times over. Numbers up to zero mean "no return". A header row is skipped.

    Args:
        path: The file.
        zones: Columns and rows of the sensor.

    Returns:
        The median of the readings at each pose, as written, shape (P, rows, columns), NaN without
        return; and the largest standard deviation of a zone's readings at each pose, (P,).

    Raises:
        CalibrationDataError: The file cannot be read, or a row does not hold whole readings.
    """
    columns, rows = zones
    lines = lines_of(read_text(path))
    if lines and not any(any_numbers(text).shape == () for text in lines[0][1]):
        lines = lines[1:]
    readings = [_readings(line, columns * rows, path) for line in lines]
    known = [np.ma.masked_where(~(one > 0), one) for one in readings]
    medians = [np.ma.filled(np.ma.median(one, axis=0), np.nan) for one in known]
    found = np.reshape(medians, (-1, rows, columns))
    if not np.isfinite(found).any():
        raise CalibrationDataError(f"{path}: no distance is above zero.")
    return found, np.array([float(np.ma.filled(one.std(axis=0), 0.0).max()) for one in known])


def _readings(line: Line, zones: int, path: Path) -> np.ndarray:
    """Return the readings of one row, shape (R, zones)."""
    number, fields = line
    # A time, or a number of the row.
    if any_numbers(fields[0]).shape or (len(fields) % zones == 1 and zones > 1):
        fields = fields[1:]
    values = any_numbers(fields)
    if not values.size or values.size % zones:
        said = f"{values.size} numbers are not whole readings of {zones} zones (--zones)"
        raise CalibrationDataError(f"{path}, line {number}: {said}.")
    return np.where(np.isfinite(values), values, 0.0).reshape(-1, zones)
