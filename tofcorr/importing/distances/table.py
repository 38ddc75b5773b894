"""Rows of distances in a text file: one row a pose, one or several readings a row."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tofcorr.errors import CalibrationDataError
from tofcorr.importing.poses.text import Line, lines_of, read_text

_LEAST_MILLIMETRES = 20.0
"""A typical number from here on is in millimetres, below in metres: no such sensor sees 20 m."""


@dataclass(frozen=True, kw_only=True, eq=False)
class DistanceTable:
    """Distances at each pose.

    Attributes:
        metres: Median of the readings at each pose, shape (P, rows, columns); NaN without return.
        readings: Smallest and largest number of readings of a pose.
        unit_mm: Millimetres per count.
        typical: Median number in the file, as written.
    """

    metres: np.ndarray
    readings: tuple[int, int]
    unit_mm: float
    typical: float


def read_distances(path: Path, zones: tuple[int, int], unit_mm: float | None) -> DistanceTable:
    """Read a table of distances.

    A row holds, after an optional time stamp, the distances of all zones row by row, once or
    several times over. Numbers up to zero mean "no return". A header row is skipped.

    Args:
        path: The file.
        zones: Columns and rows of the sensor.
        unit_mm: Millimetres per count; None: 1 if numbers are typically above 20, else 1000.

    Raises:
        CalibrationDataError: The file cannot be read, or a row does not hold whole readings.
    """
    columns, rows = zones
    lines = lines_of(read_text(path))
    if lines and all(_number(text) is None for text in lines[0].fields):
        lines = lines[1:]
    if not lines:
        raise CalibrationDataError(f"{path}: expected distances, found none.")
    readings = [_readings(line, columns * rows, path) for line in lines]
    counts = np.concatenate([one.ravel() for one in readings])
    returned = counts[counts > 0]
    if not returned.size:
        raise CalibrationDataError(f"{path}: no distance is above zero.")
    typical = float(np.median(returned))
    if unit_mm is None:
        unit_mm = 1.0 if typical >= _LEAST_MILLIMETRES else 1000.0
    medians = np.stack([_median(one) for one in readings])
    return DistanceTable(
        metres=(1e-3 * unit_mm * medians).reshape(-1, rows, columns),
        readings=(min(map(len, readings)), max(map(len, readings))),
        unit_mm=unit_mm,
        typical=typical,
    )


def _readings(line: Line, zones: int, path: Path) -> np.ndarray:
    """Return the readings of one row, shape (R, zones)."""
    values = [_number(text) for text in line.fields]
    if values and values[0] is None:
        values = values[1:]
    elif len(values) % zones == 1 and zones > 1:
        # A time in seconds, or a number of the row.
        values = values[1:]
    if any(value is None for value in values):
        shown = next(t for t, v in zip(line.fields[::-1], values[::-1], strict=False) if v is None)
        raise CalibrationDataError(
            f"{path}, line {line.number}: expected numbers, got '{shown[:40]}'."
        )
    if not values or len(values) % zones:
        raise CalibrationDataError(
            f"{path}, line {line.number}: {len(values)} numbers are not whole readings of {zones} "
            "zones. State the sensor's zones with --zones COLUMNSxROWS."
        )
    return np.array(values, dtype=np.float64).reshape(-1, zones)


def _median(readings: np.ndarray) -> np.ndarray:
    """Return the median of each zone over its returns, shape (zones,); NaN without one."""
    medians = np.full(readings.shape[1], np.nan)
    for zone, column in enumerate(readings.T):
        returned = column[np.isfinite(column) & (column > 0)]
        if returned.size:
            medians[zone] = np.median(returned)
    return medians


def _number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None
