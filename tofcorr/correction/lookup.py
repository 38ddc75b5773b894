"""The corrector as a look-up table, for programs that have NumPy and nothing else."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np

from tofcorr.correction.metadata import LutMetadata
from tofcorr.errors import CalibrationDataError
from tofcorr.files import UNREADABLE, open_regular, reading, refuse_bomb

FORMAT = "tofcorr-lut"


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
            got = f"{depth.shape}, {amplitude.shape}"
            raise ValueError(f"expected the camera's {self.offset.shape}; got {got}.")
        validity = self.metadata["validity"]
        depth = np.where((depth > 0) & np.isfinite(depth), depth, np.float32(np.nan))
        radial = depth * self.radial_of_z
        valid, row = _place(radial, validity["radial_distance_m"])
        column = np.zeros((), dtype=np.float32)
        if self.table.shape[1] > 1:
            inside, column = _place(amplitude, validity["amplitude"])
            valid &= inside
        if validity.get("normalised_amplitude") is not None:
            low, high = validity["normalised_amplitude"]
            held = np.clip(radial, *validity["radial_distance_m"])
            normalised = np.clip(amplitude, *validity["amplitude"]) * held**2
            valid &= (normalised >= low) & (normalised <= high)
        if validity.get("saturation_amplitude") is not None:
            valid &= ~(amplitude >= validity["saturation_amplitude"])
        error = self.offset + interpolate(self.table, row, column)
        return (depth - error / self.radial_of_z).astype(np.float32), valid


def read_lut(path: Path | str) -> LookupTable:
    """Read a table that `tofcorr export --format lut` wrote.

    Raises:
        CalibrationDataError: There is no such file, or it is not such a table.
    """
    with reading(path), open_regular(path) as archive:
        try:
            file = np.load(archive, allow_pickle=False)
            refuse_bomb(file.zip)
            metadata = json.loads(str(file["metadata"]))
            arrays = {n: np.asarray(file[n]) for n in ("offset", "table", "radial_of_z")}
        except UNREADABLE:
            said = f"{path}: is not a look-up table of tofcorr export."
            raise CalibrationDataError(said) from None
    known = LutMetadata.from_mapping(metadata, f"{path}, metadata", CalibrationDataError)
    _refuse_other_arrays(arrays, known, path)
    return LookupTable(**arrays, metadata=metadata)


def digest_of(arrays: Mapping[str, np.ndarray]) -> str:
    """Return the digest of the arrays of a table, their names, types and shapes included."""
    digest = sha256()
    for name, array in sorted(arrays.items()):
        digest.update(f"{name} {array.dtype.str} {array.shape}\n".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def _refuse_other_arrays(
    arrays: Mapping[str, np.ndarray], metadata: LutMetadata, path: Path | str
) -> None:
    """Refuse arrays that do not fit the metadata, or were changed."""
    shapes = {name: array.shape for name, array in arrays.items()}
    size, camera, validity = shapes["offset"], metadata.camera, metadata.validity
    rows, columns = shapes["table"] if len(shapes["table"]) == 2 else (0, 0)
    reads_amplitude = columns > 1 or validity.normalised_amplitude is not None
    fits = (
        len(size) == 2
        and min(size) > 0
        and (camera.height or size[0], camera.width or size[1]) == size
        and shapes["radial_of_z"] in (size, (1, 1))
        and rows > 1
        and columns > 0
        and not (reads_amplitude and validity.amplitude is None)
        and all(one.dtype.kind == "f" and np.isfinite(one).all() for one in arrays.values())
    )
    if not fits:
        raise CalibrationDataError(f"{path}: is damaged, arrays misfit or not finite: {shapes}.")
    if metadata.lut.sha256 not in (None, digest_of(arrays)):
        raise CalibrationDataError(f"{path}: its arrays were changed after they were written.")


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
