"""The text of `frames.csv`."""

import csv
import io
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from tofcorr.conditions import OPTIONAL_CONDITIONS, Condition
from tofcorr.data.columns import REQUIRED_COLUMNS
from tofcorr.data.table import FrameRow


def table_text(rows: Iterable[FrameRow]) -> str:
    """Return `frames.csv` of these rows; an optional column is left out if no row has it."""
    rows = list(rows)
    optional: dict[str, Callable[[FrameRow], Any]] = {
        "pose_id": lambda row: row.pose_id,
        **{condition.column: _reader_of(condition) for condition in OPTIONAL_CONDITIONS},
    }
    kept = {
        name: value for name, value in optional.items() if any(value(r) is not None for r in rows)
    }
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*REQUIRED_COLUMNS, *kept])
    for frame, row in enumerate(rows):
        # The csv module writes None as an empty cell: unknown.
        writer.writerow([frame, *_required_cells(row), *(value(row) for value in kept.values())])
    return text.getvalue()


def _required_cells(row: FrameRow) -> list[Any]:
    from scipy.spatial.transform import Rotation  # Slow to import; few commands need it.

    pose = np.asarray(row.world_from_tool, dtype=np.float64)
    quaternion = Rotation.from_matrix(pose[:3, :3]).as_quat()  # Scalar last, as in the file.
    normal = np.asarray(row.normal_world, dtype=np.float64)
    numbers = [row.timestamp, *pose[:3, 3], *quaternion, *normal, row.offset]
    return [*(float(value) for value in numbers), row.target]


def _reader_of(condition: Condition) -> Callable[[FrameRow], float | None]:
    def read(row: FrameRow) -> float | None:
        value = getattr(row, condition.name)
        if value is None or np.isnan(value):
            return None
        if condition.si_per_unit == 1:
            return float(value)
        # Converted values are written with 15 digits: 500 us, not 500.00000000000006.
        return float(f"{value / condition.si_per_unit:.15g}")

    return read
