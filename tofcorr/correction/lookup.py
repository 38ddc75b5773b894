"""The corrector as a look-up table, for programs that have NumPy and nothing else."""

import json
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tofcorr.errors import CalibrationDataError

FORMAT, VERSION = "tofcorr-lut", 1


@dataclass(frozen=True, kw_only=True)
class LookupTable:
    """The error of a pixel as one offset, and a table over distance and amplitude.

    error = offset[row, column] + table(radial distance, amplitude), the table by bilinear
    interpolation between equally spaced nodes that span the calibrated ranges.

    Attributes:
        offset: Shape (H, W), metres.
        table: Shape (R, A), metres; A is 1 if the error does not depend on the amplitude.
        radial_of_z: Radial distance over depth, shape (H, W), or (1, 1) of 1 for radial depth.
        metadata: As `corrector.metadata()`.
    """

    offset: np.ndarray
    table: np.ndarray
    radial_of_z: np.ndarray
    metadata: dict[str, Any]

    def __call__(self, depth: np.ndarray, amplitude: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Correct frames, as `corrector.ts` does.

        Args:
            depth: Depth of the camera's kind, shape (H, W) or (B, H, W), float32, metres.
            amplitude: The camera's amplitudes, same shape.

        Returns:
            Corrected depth, float32, NaN where there is no return; where it is valid, bool.

        Raises:
            ValueError: The frame is of another size.
        """
        if depth.shape[-2:] != self.offset.shape or amplitude.shape != depth.shape:
            raise ValueError(
                f"depth and amplitude: expected the camera's {self.offset.shape}, or a batch of "
                f"them; got {depth.shape} and {amplitude.shape}."
            )
        validity = self.metadata["validity"]
        depth = np.where((depth > 0) & np.isfinite(depth), depth, np.float32(np.nan))
        radial = depth * self.radial_of_z
        valid, row = _place(radial, validity["radial_distance_m"])
        column = np.zeros((), dtype=np.float32)
        if self.table.shape[1] > 1:
            inside, column = _place(amplitude, validity["amplitude"])
            valid &= inside
        if validity["normalised_amplitude"] is not None:
            low, high = validity["normalised_amplitude"]
            held = np.clip(radial, *validity["radial_distance_m"])
            normalised = np.clip(amplitude, *validity["amplitude"]) * held**2
            valid &= (normalised >= low) & (normalised <= high)
        if validity["saturation_amplitude"] is not None:
            valid &= ~(amplitude >= validity["saturation_amplitude"])
        error = self.offset + interpolate(self.table, row, column)
        return (depth - error / self.radial_of_z).astype(np.float32), valid


def read_lut(path: Path | str) -> LookupTable:
    """Read a table that `tofcorr export --format lut` wrote.

    Raises:
        CalibrationDataError: There is no such file, or it is not such a table.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            metadata = json.loads(str(file["metadata"]))
            arrays = {name: file[name] for name in ("offset", "table", "radial_of_z")}
    except FileNotFoundError:
        raise CalibrationDataError(f"{path}: there is no such file.") from None
    except (OSError, ValueError, KeyError, TypeError, zipfile.BadZipFile):
        raise CalibrationDataError(
            f"{path}: is not a look-up table that tofcorr export wrote."
        ) from None
    if metadata.get("lut") != {"format": FORMAT, "version": VERSION}:
        raise CalibrationDataError(f"{path}: is a table of another version of tofcorr.")
    return LookupTable(**arrays, metadata=metadata)


def interpolate(table: np.ndarray, row: np.ndarray, column: np.ndarray) -> np.ndarray:
    """Interpolate a table (R, A) bilinearly.

    Args:
        table: Values at nodes equally spaced over the unit square.
        row: Where along the first axis, in [0, 1]; NaN gives NaN.
        column: Where along the second axis, in [0, 1]; not read if A is 1.

    Returns:
        Values, shape of `row`.
    """
    rows, columns = table.shape
    flat = table.reshape(-1)
    top, down = _node(row, rows)
    if columns == 1:
        return flat[top] + (flat[top + 1] - flat[top]) * down
    left, right = _node(column, columns)
    above = top * columns + left
    below = above + columns
    upper = flat[above] + (flat[above + 1] - flat[above]) * right
    lower = flat[below] + (flat[below + 1] - flat[below]) * right
    return upper + (lower - upper) * down


def _node(place: np.ndarray, nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the node below each place, and the share of the step beyond it."""
    position = place * np.float32(nodes - 1)
    node = np.minimum(np.nan_to_num(position).astype(np.intp), nodes - 2)
    return node, position - node.astype(position.dtype)


def _place(values: np.ndarray, interval: list[float]) -> tuple[np.ndarray, np.ndarray]:
    """Return which values are inside an interval, and each clamped value scaled to [0, 1]."""
    low, high = np.float32(interval[0]), np.float32(interval[1])
    held = np.clip(values, low, high)
    return held == values, (held - low) / (high - low or np.float32(1))
