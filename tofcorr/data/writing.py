"""Recordings written frame by frame, whole or not at all."""

import shutil
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

from tofcorr.data import columns, header
from tofcorr.data.header import DepthKind
from tofcorr.data.recording import Recording
from tofcorr.data.rigid import refuse_unless_rigid
from tofcorr.data.staging import StagedFolder, cannot_write
from tofcorr.data.table import FrameRow, FrameTable
from tofcorr.data.table_writing import table_text
from tofcorr.errors import CalibrationDataError
from tofcorr.geometry.intrinsics import CameraIntrinsics
from tofcorr.options import dump_yaml


class RecordingWriter:
    """Writes a recording frame by frame; the folder appears when the block ends well.

    Until then the files lie in a hidden folder beside it, which any exception, Ctrl-C included,
    removes. Nothing is overwritten. What is written has passed the checks of `Recording.open`.

    Args:
        path: Where the recording shall appear. Nothing may be there yet.
        camera: The lateral parameters.
        depth_kind: `radial`: depth is along the viewing ray; `z`: along the optical axis.
        modulation_frequency: Hz; None if unknown.
        saturation_amplitude: Pixels at or above it are not used; None if unknown.
        tool_from_camera: The starting guess of the hand-eye transform, shape (4, 4); None:
            unknown, written as the identity.

    Raises:
        CalibrationDataError: Something is at `path` already, a value is not allowed, or the disk
            refuses.

    Example:
        with RecordingWriter("wall", camera=camera, depth_kind="radial") as writer:
            for depth, amplitude, row in measurements:
                writer.append(depth, row=row, amplitude=amplitude)
    """

    def __init__(
        self,
        path: Path | str,
        *,
        camera: CameraIntrinsics,
        depth_kind: DepthKind,
        modulation_frequency: float | None = None,
        saturation_amplitude: float | None = None,
        tool_from_camera: np.ndarray | None = None,
    ) -> None:
        self._header = header.build_header(
            camera, depth_kind, modulation_frequency, saturation_amplitude, tool_from_camera
        )
        self._rows: list[FrameRow] = []
        self._rows_from: Path | None = None
        self._num_frames = 0
        self._streams: dict[str, _ArrayStream] = {}
        self._stage = StagedFolder(path)
        self.path = self._stage.path

    @classmethod
    def like(cls, path: Path | str, recording: Recording) -> Self:
        """Begin a recording with the header and the rows of another, images to be appended.

        `frames.csv` is copied as it is, columns of other tools included; `append` then takes no
        row, and as many frames must be appended as `recording` has.
        """
        writer = cls(
            path,
            camera=recording.camera,
            depth_kind=recording.depth_kind,
            modulation_frequency=recording.modulation_frequency,
            saturation_amplitude=recording.saturation_amplitude,
            tool_from_camera=recording.tool_from_camera,
        )
        writer._rows_from = recording.path / columns.FILE_NAME
        return writer

    def append(
        self,
        depth: np.ndarray,
        *,
        row: FrameRow | None = None,
        amplitude: np.ndarray | None = None,
        mask: np.ndarray | None = None,
        raw: np.ndarray | None = None,
        truth: Mapping[str, np.ndarray] | None = None,
    ) -> None:
        """Write one frame.

        Args:
            depth: Shape (H, W), metres; NaN or <= 0: no return.
            row: What else is known of the frame; left out after `like`.
            amplitude: Shape (H, W), not negative. Either all frames have one or none does.
            mask: Shape (H, W), 0 or 1 (or bool), 1 on the target. All frames or none.
            raw: Correlation samples A0..A3, shape (4, H, W). All frames or none.
            truth: A simulator's arrays of this frame, by name, any shape: `truth/NAME.npy` is
                their stack, in the type of the first.

        Raises:
            CalibrationDataError: A shape or value is not allowed, or the disk refuses.
        """
        if (row is None) != (self._rows_from is not None):
            raise CalibrationDataError(
                f"{self.path}: frame {self._num_frames}: a row is needed for each frame, "
                "unless the rows are another recording's."
            )
        if row is not None:
            self._check_pose(row)
        size = (self._header.camera.height, self._header.camera.width)
        given = {
            "depth": (depth, np.float32, size),
            "amplitude": (amplitude, np.float32, size),
            "mask": (mask, np.uint8, size),
            "raw": (raw, np.float32, (4, *size)),
        }
        images = {name: v for name, v in given.items() if v[0] is not None}
        for name, frame in (truth or {}).items():
            images[f"truth/{name}"] = (frame, np.asarray(frame).dtype, np.shape(frame))
        try:
            self._write_images(images)
        except OSError as error:
            raise CalibrationDataError(cannot_write(self.path, error)) from None
        if row is not None:
            self._rows.append(row)
        self._num_frames += 1

    def add_truth(self, name: str, value: np.ndarray | Mapping[str, Any]) -> None:
        """Write `truth/NAME.npy` (an array) or `truth/NAME.yaml` (keys and values)."""
        folder = self._stage.folder / "truth"
        try:
            folder.mkdir(exist_ok=True)
            if isinstance(value, Mapping):
                (folder / f"{name}.yaml").write_text(dump_yaml(value), encoding="utf-8")
            else:
                np.save(folder / f"{name}.npy", np.asarray(value), allow_pickle=False)
        except OSError as error:
            raise CalibrationDataError(cannot_write(self.path, error)) from None

    def __enter__(self) -> Self:
        """Return the writer."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Finish and check the recording and rename it into place, or leave nothing."""
        try:
            if kind is None:
                self._finish()
                self._stage.commit()
        except OSError as failure:
            raise CalibrationDataError(cannot_write(self.path, failure)) from None
        except CalibrationDataError as failure:
            # The reader's checks speak of the temporary folder.
            message = str(failure).replace(str(self._stage.folder), str(self.path))
            raise CalibrationDataError(message) from None
        finally:
            for stream in self._streams.values():
                stream.abandon()
            self._stage.discard()

    def _check_pose(self, row: FrameRow) -> None:
        """Refuse what could not be written as a quaternion; the reader checks all the rest."""
        try:
            refuse_unless_rigid(np.asarray(row.world_from_tool, dtype=np.float64))
        except ValueError as error:
            raise CalibrationDataError(
                f"{self.path}: frame {self._num_frames}, world_from_tool: {error}."
            ) from None

    def _write_images(self, images: Mapping[str, tuple[Any, Any, tuple[int, ...]]]) -> None:
        if self._num_frames == 0:
            for name, (_, dtype, shape) in images.items():
                self._streams[name] = _ArrayStream(
                    self._stage.folder / f"{name}.npy", np.dtype(dtype), shape
                )
        if images.keys() != self._streams.keys():
            differing = ", ".join(sorted(images.keys() ^ self._streams.keys()))
            raise CalibrationDataError(
                f"{self.path}: frame {self._num_frames}: {differing} must be given "
                "for all frames or for none."
            )
        where = f"{self.path}: frame {self._num_frames}"
        frames = {
            name: self._streams[name].convert(frame, f"{where}, {name}")
            for name, (frame, _, _) in images.items()
        }
        for name, frame in frames.items():
            self._streams[name].write(frame)

    def _finish(self) -> None:
        for stream in self._streams.values():
            stream.finish(self._num_frames)
        folder = self._stage.folder
        text = header.header_text(self._header)
        (folder / header.FILE_NAME).write_text(text, encoding="utf-8")
        if self._rows_from is not None:
            shutil.copyfile(self._rows_from, folder / columns.FILE_NAME)
        else:
            rows = table_text(self._rows)
            (folder / columns.FILE_NAME).write_text(rows, encoding="utf-8", newline="")
        if self._num_frames == 0:
            raise CalibrationDataError(f"{self.path}: a recording of no frame.")
        # Amplitude and mask were checked as they came.
        Recording.open(folder, check_contents=False)


class _ArrayStream:
    """One `.npy` file that grows frame by frame; its header is set right at the end."""

    def __init__(self, path: Path, dtype: np.dtype, frame_shape: tuple[int, ...]) -> None:
        if dtype.hasobject:
            raise ValueError(f"{path.name}: expected an array of numbers, got {dtype}.")
        path.parent.mkdir(exist_ok=True)
        self._dtype = dtype
        self._frame_shape = frame_shape
        self._file = path.open("w+b")
        self._write_header(0)
        self._header_bytes = self._file.tell()

    def convert(self, frame: np.ndarray, where: str) -> np.ndarray:
        """Return the frame as it goes to disk, or refuse it."""
        array = np.asarray(frame)
        if array.shape != self._frame_shape:
            raise CalibrationDataError(
                f"{where}: expected shape {self._frame_shape}, got {array.shape}."
            )
        with np.errstate(over="ignore"):
            converted = np.ascontiguousarray(array, dtype=self._dtype)
        if where.endswith(", amplitude") and np.any(array < 0):
            raise CalibrationDataError(f"{where}: negative amplitude; expected zero or more.")
        if where.endswith(", mask") and np.any((array != 0) & (array != 1)):
            raise CalibrationDataError(f"{where}: expected 0 or 1 everywhere.")
        return converted

    def write(self, frame: np.ndarray) -> None:
        self._file.write(frame.data)

    def finish(self, num_frames: int) -> None:
        self._file.seek(0)
        self._write_header(num_frames)
        if self._file.tell() != self._header_bytes:  # NumPy leaves room for 21 digits.
            raise OSError(0, "the array has too many frames for its header")
        self._file.close()

    def abandon(self) -> None:
        # Closing writes what is left in the buffer, which a full disk refuses once more.
        with suppress(OSError):
            self._file.close()

    def _write_header(self, num_frames: int) -> None:
        content = {
            "descr": np.lib.format.dtype_to_descr(self._dtype),
            "fortran_order": False,
            "shape": (num_frames, *self._frame_shape),
        }
        np.lib.format.write_array_header_1_0(self._file, content)


def write_recording(  # noqa: PLR0913 - the parts of a recording, all by keyword
    path: Path | str,
    *,
    camera: CameraIntrinsics,
    depth_kind: DepthKind,
    rows: FrameTable | Iterable[FrameRow],
    depth: np.ndarray,
    amplitude: np.ndarray | None = None,
    mask: np.ndarray | None = None,
    raw: np.ndarray | None = None,
    modulation_frequency: float | None = None,
    saturation_amplitude: float | None = None,
    tool_from_camera: np.ndarray | None = None,
    truth: Mapping[str, np.ndarray | Mapping[str, Any]] | None = None,
) -> None:
    """Write a recording whose arrays are in memory (or mapped).

    Args and errors are those of `RecordingWriter`; the arrays carry all frames on their first
    axis. `truth` goes to `truth/`, arrays as `.npy` and mappings as `.yaml`.
    """
    rows = rows.rows() if isinstance(rows, FrameTable) else list(rows)
    images = {"amplitude": amplitude, "mask": mask, "raw": raw}
    given = {name: array for name, array in images.items() if array is not None}
    for name, array in {"depth": depth, **given}.items():
        if len(array) != len(rows):
            raise CalibrationDataError(
                f"{path}: {name} has {len(array)} frames, but there are {len(rows)} rows."
            )
    with RecordingWriter(
        path,
        camera=camera,
        depth_kind=depth_kind,
        modulation_frequency=modulation_frequency,
        saturation_amplitude=saturation_amplitude,
        tool_from_camera=tool_from_camera,
    ) as writer:
        for frame, row in enumerate(rows):
            writer.append(
                depth[frame], row=row, **{name: array[frame] for name, array in given.items()}
            )
        for name, value in (truth or {}).items():
            writer.add_truth(name, value)
