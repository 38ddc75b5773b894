"""`frames.csv`: what is known of the frames besides their images, as a file and as arrays."""

import csv
import io
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from kornia.geometry.conversions import quaternion_to_rotation_matrix

from tofcorr.conditions import OPTIONAL_CONDITIONS, Condition, Conditions, Value, condition
from tofcorr.data.arrays import LARGEST_DISTANCE
from tofcorr.errors import CalibrationDataError, is_control
from tofcorr.files import open_regular, reading
from tofcorr.geometry import se3
from tofcorr.geometry.se3 import UNIT_LENGTH_TOLERANCE
from tofcorr.options import LARGEST_NUMBER, SMALLEST_POSITIVE

TABLE_FILE = "frames.csv"
TRANSLATION = ("tx", "ty", "tz")
QUATERNION = ("qx", "qy", "qz", "qw")
NORMAL = ("nx", "ny", "nz")
TIMESTAMP = condition("timestamp").column
NUMBERS = (TIMESTAMP, *TRANSLATION, *QUATERNION, *NORMAL, "d")
REQUIRED_COLUMNS = ("frame", *NUMBERS, "target")
"""Columns that every recording has, in the order in which they are written."""
COLUMN_OF = {"pose_id": "pose_id", **{each.name: each.column for each in OPTIONAL_CONDITIONS}}
"""Columns that a recording may lack, by the attribute of `FrameTable` that holds them."""
COVARIANCE = ["nx_nx", "nx_ny", "nx_nz", "nx_d", "ny_ny", "ny_nz", "ny_d", "nz_nz", "nz_d", "d_d"]
"""Columns of the covariance of (nx, ny, nz, d): all ten, or none."""
JOINT = "joint_{}"
"""Columns of the joint angles, counted from 1: of every joint, or of none."""
_UPPER = np.triu_indices(4)


@dataclass(frozen=True, kw_only=True, eq=False)
class FrameRow(Conditions[Value]):
    """What is known of one frame besides its images; the conditions are those of `Conditions`.

    Attributes:
        world_from_tool: Pose of the robot's tool, shape (4, 4); the identity without a robot.
        normal_world: Unit normal of the target's plane n . x + d = 0, on the camera's side, (3,).
        offset: d of that plane, metres.
        target: `white`, `checkerboard` or another name.
        pose_id: Frames with the same id were taken without moving; None if unknown.
        plane_covariance: Of (nx, ny, nz, d), shape (4, 4), without unit and metres: what is not
            known of the plane, independent of that of other poses; None: unknown, taken as zero.
        joint_angles: Of the robot's joints from its base on, shape (J,), radians or metres; None:
            not recorded.
    """

    world_from_tool: np.ndarray
    normal_world: np.ndarray
    offset: Value
    target: Any
    pose_id: Any = None
    plane_covariance: Any = None
    joint_angles: Any = None


class FrameTable(FrameRow[np.ndarray]):
    """The rows of `frames.csv` as arrays, one entry per frame; units as in `FrameRow`.

    A condition has shape (N,), and so have offsets, and targets and pose ids as text; poses and
    covariances have shape (N, 4, 4), joint angles (N, J), normals (N, 3), of exactly unit length.
    An optional column that the file lacks is None. An empty cell in an optional column is NaN (the
    empty text in `pose_id`): unknown, never zero.
    """

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.timestamp)

    @classmethod
    def of(cls, rows: Sequence[FrameRow]) -> Self:
        """Return the table of these rows; what none of them knows is None."""
        columns = {one.name: [getattr(row, one.name) for row in rows] for one in fields(cls)}
        known = {
            name: np.array([("" if name == "pose_id" else np.nan) if x is None else x for x in own])
            for name, own in columns.items()
            if any(x is not None for x in own)
        }
        return cls(**known)

    def select(self, indices: Sequence[int] | np.ndarray) -> Self:
        """Return the table of these frames, in this order."""
        chosen = np.asarray(indices, dtype=np.int64)
        columns = {field.name: getattr(self, field.name) for field in fields(self)}
        return replace(self, **{k: c[chosen] for k, c in columns.items() if c is not None})

    def row(self, index: int) -> FrameRow:
        """Return one frame's row; an empty cell is None in it."""
        cells: dict[str, Any] = {each.name: getattr(self, each.name) for each in fields(self)}
        cells = {name: None if c is None else c[index] for name, c in cells.items()}
        for each in OPTIONAL_CONDITIONS:
            number = cells[each.name]
            cells[each.name] = None if number is None or np.isnan(number) else float(number)
        cells |= {name: float(cells[name]) for name in ("timestamp", "offset")}
        cells |= {"target": str(cells["target"]), "pose_id": str(cells["pose_id"] or "") or None}
        return FrameRow(**cells)

    def rows(self) -> list[FrameRow]:
        """Return every frame's row."""
        return [self.row(index) for index in range(len(self))]


def read_table(path: Path, lines: Sequence[Sequence[str]] | None = None) -> FrameTable:
    """Read and check `frames.csv`.

    Columns may come in any order; unknown columns are ignored. Quaternions are normalised, and a
    plane's n and d are divided by the length of n, if the length is within the format's tolerance.

    Args:
        path: The file.
        lines: Its cells, line by line, where they were read already.

    Raises:
        CalibrationDataError: The file is missing or breaks the format; the message names column
            and frame.
    """
    cells = _columns(read_lines(path) if lines is None else lines, path)
    has_covariance = not cells.keys().isdisjoint(COVARIANCE)
    needed = [*REQUIRED_COLUMNS, *(COVARIANCE if has_covariance else ())]
    missing = [name for name in needed if name not in cells]
    if missing:
        listed = ", ".join(map(repr, missing))
        raise CalibrationDataError(f"{path}: column {listed} is missing.")
    if not cells["frame"]:
        raise CalibrationDataError(f"{path}: a recording of no frame.")
    for frame, (cell, name) in enumerate(zip(cells["frame"], cells["target"], strict=True)):
        if not re.fullmatch(f"0*{frame}", cell):
            raise _wrong(path, frame, "frame", f"{frame} (counting up from zero)", cell)
        if not name or any(map(is_control, name)):
            raise _wrong(path, frame, "target", "a name such as 'white'", name)
    number = {name: _numbers(cells, name, path) for name in NUMBERS}
    translation, quaternion, normal = (
        np.stack([number[name] for name in names], axis=1)
        for names in (TRANSLATION, QUATERNION, NORMAL)
    )
    length = np.linalg.norm(normal, axis=1)
    for frame in np.flatnonzero(np.abs(length - 1) > UNIT_LENGTH_TOLERANCE)[:1]:
        said = f"the normal nx,ny,nz has length {length[frame]:.6g}, not 1 to 0.001"
        raise CalibrationDataError(f"{path}: frame {frame}: {said}.")
    return FrameTable(
        timestamp=number[TIMESTAMP],
        world_from_tool=rigid_transforms(translation, quaternion, lambda k: f"{path}: frame {k}"),
        normal_world=normal / length[:, None],
        offset=number["d"] / length,
        target=np.array(cells["target"]),
        pose_id=np.array(cells["pose_id"]) if "pose_id" in cells else None,
        plane_covariance=_plane_covariance(cells, path) if has_covariance else None,
        joint_angles=_joint_angles(cells, path),
        **{
            each.name: each.si_per_unit * _numbers(cells, each.column, path, each)
            for each in OPTIONAL_CONDITIONS
            if each.column in cells
        },
    )


def _plane_covariance(cells: dict[str, list[str]], path: Path) -> np.ndarray:
    """Return the covariances, shape (N, 4, 4)."""
    numbers = np.stack([_numbers(cells, name, path) for name in COVARIANCE], axis=1)
    found = np.zeros((len(numbers), 4, 4))
    found[:, *_UPPER] = found[:, *_UPPER[::-1]] = numbers
    least = np.linalg.eigvalsh(found)
    # What is zero is rounded to the digits of the largest.
    for frame in np.flatnonzero(least[:, 0] < -UNIT_LENGTH_TOLERANCE * least[:, -1])[:1]:
        said = "nx_nx to d_d are no covariance: a variance is negative"
        raise CalibrationDataError(f"{path}: frame {frame}: {said}.")
    return found


def _joint_angles(cells: dict[str, list[str]], path: Path) -> np.ndarray | None:
    """Return the angles of all joints, shape (N, J); None: the file has none."""
    names = [name for name in cells if re.fullmatch(r"joint_\d+", name)]
    wanted = [JOINT.format(k + 1) for k in range(len(names))]
    for name in wanted:
        if name not in names:
            said = f"column '{name}' is missing beside {', '.join(names)}"
            raise CalibrationDataError(f"{path}: {said}; joints are counted from 1.")
    return np.stack([_numbers(cells, name, path) for name in wanted], axis=1) if wanted else None


def rigid_transforms(
    translation: np.ndarray, rotation: np.ndarray, where: Callable[[int], str]
) -> np.ndarray:
    """Return rigid transforms, shape (P, 4, 4).

    Args:
        translation: Shape (P, 3), metres.
        rotation: Quaternions, scalar last, shape (P, 4); or axes times angles, radians, (P, 3).
        where: What to call a pose in a message, by its number.

    Raises:
        CalibrationDataError: A quaternion is not of unit length to 0.001, which is what three
            decimals do to it, or an angle is larger than a whole turn.
    """
    length, of_quaternions = np.linalg.norm(rotation, axis=1), rotation.shape[1] == 4
    # Robots report half a turn at most, some up to a whole one.
    off = np.abs(length - 1) if of_quaternions else length - 2 * np.pi
    for place in np.flatnonzero(~(off <= UNIT_LENGTH_TOLERANCE)).tolist():
        said = (
            "the quaternion x y z w has length {:.4g}; expected 1."
            if of_quaternions
            else "rx, ry, rz are read as an axis times radians, here {:.4g}; are they Euler angles?"
        )
        raise CalibrationDataError(f"{where(place)}: {said.format(length[place])}")
    given, place = torch.from_numpy(rotation), torch.from_numpy(translation)
    if not of_quaternions:
        turns = se3.exp(torch.cat([torch.zeros_like(place), given], dim=1))
        return se3.assemble(turns[:, :3, :3], place).numpy()
    # kornia normalises them, and has the scalar first.
    return se3.assemble(quaternion_to_rotation_matrix(given[:, [3, 0, 1, 2]]), place).numpy()


def table_text(rows: Iterable[FrameRow], first: int | None = None) -> str:
    """Return `frames.csv` of these rows; an optional column is left out if no row has it.

    Args:
        rows: The rows.
        first: Number of the first of them where further rows will follow: then every optional
            column is written, and of a later number no header; None: these are all rows.
    """
    rows = list(rows)
    optional = {name: [_cell(row, name) for row in rows] for name in COLUMN_OF}
    kept = {
        name: cells
        for name, cells in optional.items()
        if first is not None or any(c is not None for c in cells)
    }
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    # Of some planes alone nothing can be weighed.
    known = all(row.plane_covariance is not None for row in rows)
    names = [*COVARIANCE] if known else []
    angles = [np.atleast_1d(row.joint_angles) for row in rows if row.joint_angles is not None]
    if len(angles) == len(rows) > 0:
        names += [JOINT.format(k + 1) for k in range(len(angles[0]))]
    if not first:
        writer.writerow([*REQUIRED_COLUMNS, *(COLUMN_OF[name] for name in kept), *names])
    for frame, row in enumerate(rows):
        # The csv module writes None as an empty cell: unknown.
        more = [cells[frame] for cells in kept.values()]
        more += row.plane_covariance[_UPPER].tolist() if known else []
        more += angles[frame].tolist() if len(angles) == len(rows) else []
        writer.writerow([(first or 0) + frame, *_required_cells(row), row.target, *more])
    return text.getvalue()


def _required_cells(row: FrameRow) -> list[float]:
    from scipy.spatial.transform import Rotation  # Slow to import; few commands need it.

    pose = np.asarray(row.world_from_tool, dtype=np.float64)
    quaternion = Rotation.from_matrix(pose[:3, :3]).as_quat()  # Scalar last, as in the file.
    normal = np.asarray(row.normal_world, dtype=np.float64)
    return list(map(float, [row.timestamp, *pose[:3, 3], *quaternion, *normal, row.offset]))


def _cell(row: FrameRow, name: str) -> int | str | float | None:
    """Return the value of an optional column, in the unit of the file; None: unknown."""
    value = getattr(row, name)
    if name == "pose_id" or value is None:
        return value
    per_unit = condition(name).si_per_unit
    # Converted values are written with 15 digits: 500 us, not 500.00000000000006.
    cell = float(value) if per_unit == 1 else float(f"{value / per_unit:.15g}")
    return None if np.isnan(cell) else cell


def read_lines(path: Path, *, grows: bool = False) -> list[list[str]]:
    """Return the cells of the file, line by line; blank lines are skipped.

    Args:
        path: The file.
        grows: Whether a last line without its end is one that is being written, and is left out.

    Raises:
        CalibrationDataError: The file is missing, or is no CSV.
    """
    try:
        with reading(path), open_regular(path) as file:
            content = file.read()
        content = content[: content.rfind(b"\n") + 1] if grows else content
        text = io.StringIO(content.decode("utf-8-sig"), newline="")
        return [line for line in csv.reader(text) if line]
    except (UnicodeDecodeError, csv.Error) as error:
        raise CalibrationDataError(f"{path}: cannot be read as CSV ({error}).") from None


def _columns(lines: Sequence[Sequence[str]], path: Path) -> dict[str, list[str]]:
    """Return the columns of text by their names."""
    if not lines:
        raise CalibrationDataError(f"{path}: is empty; expected a header row.")
    names = [name.strip() for name in lines[0]]
    if len(names) == 1 and ";" in names[0]:
        raise CalibrationDataError(f"{path}: columns are separated by ';'; commas are needed.")
    for name in names:
        if name and names.count(name) > 1:
            raise CalibrationDataError(f"{path}: column '{name}' appears twice.")
    for frame, line in enumerate(lines[1:]):
        if len(line) != len(names):
            raise CalibrationDataError(f"{path}: frame {frame}: {len(line)} of {len(names)} cells.")
    return {name: [line[i].strip() for line in lines[1:]] for i, name in enumerate(names)}


def _numbers(
    cells: dict[str, list[str]], name: str, path: Path, known: Condition | None = None
) -> np.ndarray:
    """Parse a column; of one that a recording may lack, which is `known`, empty cells give NaN."""
    values = np.array([_number(cell) for cell in cells[name]])
    metres = name in (*TRANSLATION, "d")
    most, unit = (LARGEST_DISTANCE, " of metres") if metres else (LARGEST_NUMBER, "")
    least = SMALLEST_POSITIVE if known and known.positive else -most
    wrong = ~((values >= least) & (values <= most) | (np.isnan(values) & (known is not None)))
    expected = f"a {'positive' if least > 0 else 'finite'} number{unit}, at most {most:g}"
    for frame in np.flatnonzero(wrong)[:1]:
        raise _wrong(path, int(frame), name, expected, cells[name][frame])
    return values


def _number(cell: str) -> float:
    """Return the number in a cell; NaN if it is empty, infinity if it holds something else."""
    try:
        # Python's float() reads 1_0 as ten.
        return float(cell.replace("_", "?") or "nan")
    except ValueError:
        return np.inf


def _wrong(path: Path, frame: int, column: str, expected: str, got: str) -> CalibrationDataError:
    shown = repr(got[:40]) if got else "an empty cell"
    said = f"expected {expected}, got {shown}"
    return CalibrationDataError(f"{path}: frame {frame}, column '{column}': {said}.")
