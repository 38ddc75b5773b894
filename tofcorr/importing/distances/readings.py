"""Distances and poses of a sensor of one or a few zones before one or several walls."""

import math
import re
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from tofcorr.errors import CalibrationDataError, ConfigError
from tofcorr.importing.images import DepthCoding, DepthImage, turned
from tofcorr.importing.intrinsics import GivenIntrinsics, intrinsics_from_numbers
from tofcorr.importing.numbers import Line, any_numbers, lines_of, read_text
from tofcorr.importing.pose_files import read_poses
from tofcorr.importing.pose_track import LEAST_SECONDS, PoseTrack
from tofcorr.importing.robot_images import RobotImages
from tofcorr.importing.run import RefusedViewError

Planes = Sequence[tuple[float, ...]]
_FILES = {"distances": "measurements.csv", "poses": "transforms.csv"}
"""What a folder holds."""


def layout_of(zones: str, order: str, flip: str, rotate: str) -> np.ndarray:
    """Return where each zone stands in a reading, counted from zero, shape (H, W).

    Most sensors have 8 zones a side (VL53L5CX); those of more than 64 give images, not tables.

    Args:
        zones: COLUMNSxROWS as written, such as `8x8`.
        order: `rows`: row by row; or `columns`.
        flip: `horizontal`: each row is written from right to left; `vertical`: from the bottom;
            `both`; or `none`.
        rotate: Degrees clockwise by which what was flipped is turned.

    Raises:
        ConfigError: `zones` is something else.

    Example:
        >>> layout_of("3x2", "columns", "horizontal", "0").tolist()
        [[4, 2, 0], [5, 3, 1]]
    """
    match = re.fullmatch(r"(\d+)x(\d+)", zones.strip().lower())
    if match is None or not all(1 <= int(part) <= 64 for part in match.groups()):
        raise ConfigError(f"--zones must be COLUMNSxROWS, such as 1x1 or 8x8, got '{zones[:40]}'.")
    shape = int(match[2]), int(match[1])
    places = np.arange(shape[0] * shape[1]).reshape(shape, order="C" if order == "rows" else "F")
    axes = {"none": (), "vertical": (0,), "horizontal": (1,), "both": (0, 1)}
    return turned(np.flip(places, axes[flip]), int(rotate))


def sensor_lens(layout: np.ndarray, field_of_view_deg: tuple[float, ...] | None) -> GivenIntrinsics:
    """Return the intrinsics of a pinhole camera with one pixel a zone.

    Args:
        layout: Of the zones, shape (H, W).
        field_of_view_deg: Of all zones together, horizontally and vertically (one number: both),
            degrees; not needed for one pixel, whose ray is the optical axis.

    Raises:
        ConfigError: A field of view is missing, or not between 0 and 180 degrees.
    """
    rows, columns = layout.shape
    focal, zones = [1.0, 1.0], (columns, rows)
    if layout.size > 1:
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
    layout: np.ndarray,
    lens: GivenIntrinsics,
    coding: DepthCoding,
    *,
    poses: Sequence[Path] = (),
    pose_format: str | None = None,
    names: Sequence[str] = (),
    planes: Planes = (),
) -> RobotImages:
    """Read distances before one or several walls, as images of a few pixels.

    Args:
        sources: Files of distances before one wall each, or folders with one and a file of poses.
        layout: Where each zone stands in a reading, shape (H, W).
        lens: The zones as pixels.
        coding: Millimetres per count, None: inferred; and the numbers that mean "no return",
            besides those up to zero.
        poses: For each source a file of poses; none where folders hold them.
        pose_format: Of `tofcorr.importing.pose_files.POSE_FORMATS`; None: told from the content.
        names: What each source's wall is called; none: as the file or folder.
        planes: Where each source's wall was measured, (nx, ny, nz, d), metres; none: unknown.

    Raises:
        CalibrationDataError: A file is missing or damaged, or rows and poses are not as many.
        ConfigError: There are not as many poses, names or planes as sources, or two planes of one
            wall.
    """
    for what, every in (("--poses", poses), ("--wall", names), ("--plane", planes)):
        if every and len(every) != len(sources):
            raise ConfigError(f"expected one {what} per source ({len(sources)}), got {len(every)}.")
    names, warnings = _wall_names(sources, names, planes), list[str]()
    files = [_file_in(source, "distances") for source in sources]
    tables = [read_distances(path, layout, coding.invalid, warnings) for path in files]
    paths = poses or [_file_in(source, "poses") for source in sources]
    given = [read_poses(path, pose_format) for path in paths]
    # Row by row: a pose that is repeated belongs to its row nevertheless.
    tracks = [track.world_from_tool[track.of_row] for track in given]
    for path, track, (table, _) in zip(paths, tracks, tables, strict=True):
        if len(track) != len(table):
            raise CalibrationDataError(f"{path}: {len(track)} poses beside {len(table)} rows.")
    warnings += [f"{said}; each belongs to its own row." for one in given for said in one.repeats]
    readings, scatter = (np.concatenate(part) for part in zip(*tables, strict=True))
    typical = float(np.nanmedian(readings))
    # No such sensor sees 20 m.
    unit = coding.unit_mm or (1.0 if typical >= 20 else 1000.0)
    if coding.unit_mm is None:
        word = "millimetres" if unit == 1 else "metres"
        read_as = f"Distances are typically {typical:g} and read as {word}"
        warnings.append(f"{read_as}; state --depth-unit-mm {unit:g} if that is right.")
    if layout.size == 1:
        warnings.append("One pixel: its ray is the optical axis; a turn about it cannot be found.")
    origin = ", ".join(map(str, sources)) if len(sources) < 3 else f"{sources[0]}, ..."
    metres = (unit * readings / 1000).astype(np.float32)

    def read(number: int) -> DepthImage:
        if not np.isfinite(metres[number]).any():
            raise RefusedViewError("no zone has a return")
        return DepthImage(metres[number])

    targets = np.repeat(names, [len(table) for table, _ in tables])
    # Counted on from file to file of one wall.
    rows = [np.sum(targets[:k] == name) for k, name in enumerate(targets)]
    usual, worst = unit * float(np.median(scatter)), int(scatter.argmax())
    if (most := unit * float(scatter[worst])) > max(20, 10 * usual):  # No noise, no sensor's error.
        where = f"row {rows[worst]} of {targets[worst]}"
        said = f"{where} scatter by {most:.0f} mm, of most by {usual:.0f} mm: leave it out."
        warnings.append(f"The readings of {said}")
    return RobotImages(
        origin=origin,
        names=[f"{name} {row}" for name, row in zip(targets, rows, strict=True)],
        intrinsics=lens,
        read=read,
        track=PoseTrack.checked(np.concatenate(tracks), origin),
        targets=targets,
        planes=dict(zip(names, map(np.array, planes), strict=True)) if planes else None,
        warnings=warnings,
    )


def _wall_names(sources: Sequence[Path], names: Sequence[str], planes: Planes) -> Sequence[str]:
    found = [*names] or [source.stem for source in sources]
    if not names and len(set(found)) < len(found):
        raise ConfigError(f"Two sources have one name: {', '.join(found)}. Name their --wall.")
    if planes and len(set(zip(found, planes, strict=True))) > len(set(found)):
        raise ConfigError("One --wall has two different planes (--plane); expected one.")
    if not all(any(plane[:3]) for plane in planes):
        raise ConfigError("--plane must be NX,NY,NZ,D with a normal that is not zero.")
    return found


def _file_in(source: Path, what: str) -> Path:
    """Return the file itself, or the one of distances or poses in a folder."""
    if source.is_dir():
        return source / _FILES[what]
    if what == "poses":
        raise ConfigError(f"{source} is a file: name its poses with --poses.")
    return source


def read_distances(
    path: Path, layout: np.ndarray, invalid: tuple[float, ...], warnings: list[str]
) -> tuple[np.ndarray, np.ndarray]:
    """Read a table of distances: one row a pose, one or several readings a row.

    A row holds, after an optional time stamp, the distances of all zones, once or several times
    over. Numbers up to zero mean "no return". A header row is skipped.

    Args:
        path: The file.
        layout: Where each zone stands in a reading, shape (H, W).
        invalid: Further numbers that mean "no return".
        warnings: Gets a sentence where rows repeat a time stamp.

    Returns:
        The median of the readings at each pose, as written, shape (P, H, W), NaN without return;
        and the largest standard deviation of a zone's readings at each pose, (P,).

    Raises:
        CalibrationDataError: The file cannot be read, or a row does not hold whole readings.
    """
    lines = lines_of(read_text(path))
    if lines and not any(any_numbers(text).shape == () for text in lines[0][1]):
        lines = lines[1:]
    rows = [_readings(line, layout.size, path) for line in lines]
    masked = [np.ma.masked_where(~(one > 0) | np.isin(one, invalid), one) for _, one in rows]
    medians = [np.ma.filled(np.ma.median(one, axis=0), np.nan) for one in masked]
    if not np.isfinite(medians).any():
        raise CalibrationDataError(f"{path}: no distance is above zero.")
    if alike := sum(before[0] == after[0] != "" for before, after in pairwise(rows)):
        warnings.append(f"{path}: {alike} rows repeat the time stamp before them; all are used.")
    scatter = [float(np.ma.filled(one.std(axis=0), 0.0).max()) for one in masked]
    return np.array(medians)[:, layout], np.array(scatter)


def _readings(line: Line, zones: int, path: Path) -> tuple[str, np.ndarray]:
    """Return the time stamp of one row, empty without one, and its readings, shape (R, zones)."""
    (number, fields), stamp = line, ""
    first = any_numbers(fields[0])
    # A time, or a number of the row. No distance is a time since 1970.
    if first.shape or first >= LEAST_SECONDS or (len(fields) % zones == 1 and zones > 1):
        stamp, *fields = fields
    values = any_numbers(fields)
    if not values.size or values.size % zones:
        said = f"{values.size} numbers are not whole readings of {zones} zones (--zones)"
        raise CalibrationDataError(f"{path}, line {number}: {said}.")
    return stamp, np.where(np.isfinite(values), values, 0.0).reshape(-1, zones)
