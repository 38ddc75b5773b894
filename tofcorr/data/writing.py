"""Recordings written frame by frame, whole or not at all."""

import shutil
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, Self

import numpy as np

from tofcorr.data import columns, header
from tofcorr.data.array_stream import ArrayStream
from tofcorr.data.header import DepthKind, PlaneOrigin
from tofcorr.data.images import IMAGE_ARRAYS
from tofcorr.data.recording import Recording
from tofcorr.data.rigid import refuse_unless_rigid
from tofcorr.data.table import FrameRow
from tofcorr.data.table_writing import table_text
from tofcorr.errors import CalibrationDataError
from tofcorr.files.staged import StagedFolder, cannot_write
from tofcorr.geometry.frame_names import FrameNames
from tofcorr.geometry.intrinsics import CameraIntrinsics
from tofcorr.options import dump_yaml


class RecordingWriter:
    """Writes a recording frame by frame; the folder appears when the block ends without an error.

    Until then the files are in a hidden folder beside it. Any exception, Ctrl-C included, removes
    that folder. Nothing is overwritten. The checks of `Recording.open` are applied to all files.

    Args:
        path: The folder to write; it must not exist yet.
        camera: The camera intrinsics.
        depth_kind: `radial`: depth is along the viewing ray; `z`: along the optical axis.
        modulation_frequency: Hz; None if unknown.
        saturation_amplitude: Pixels at or above it are not used; None if unknown.
        tool_from_camera: The starting guess of the hand-eye transform, shape (4, 4); None:
            unknown, written as the identity.
        planes: `estimated`: the rows' planes were found in the depth and are a start for the fit;
            `recorded`: they were measured by other means.
        frame_names: What the robot calls its coordinate frames; None: world, tool, camera.

    Raises:
        CalibrationDataError: `path` exists already, a value is not allowed, or the files cannot be
            written.

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
        planes: PlaneOrigin = "recorded",
        frame_names: FrameNames | None = None,
    ) -> None:
        self._header = header.build_header(
            camera,
            depth_kind,
            modulation_frequency,
            saturation_amplitude,
            tool_from_camera,
            planes,
            frame_names,
        )
        self._rows: list[FrameRow] = []
        self._rows_from: Path | None = None
        self._num_frames = 0
        self._streams: dict[str, ArrayStream] = {}
        self._stage = StagedFolder(path)
        self.path = self._stage.path

    @classmethod
    def with_header_of(cls, path: Path | str, recording: Recording) -> Self:
        """Begin a recording with the header of another one; its frames are appended."""
        return cls(
            path,
            camera=recording.camera,
            depth_kind=recording.depth_kind,
            modulation_frequency=recording.modulation_frequency,
            saturation_amplitude=recording.saturation_amplitude,
            tool_from_camera=recording.tool_from_camera,
            planes=recording.planes,
            frame_names=recording.frame_names,
        )

    @classmethod
    def like(cls, path: Path | str, recording: Recording) -> Self:
        """Begin a recording with the header and the rows of another one; its images are appended.

        `frames.csv` is copied unchanged, with the columns of other tools. `append` then takes no
        row, and as many frames must be appended as `recording` has.
        """
        writer = cls.with_header_of(path, recording)
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
        true_depth: np.ndarray | None = None,
        truth: Mapping[str, np.ndarray] | None = None,
    ) -> None:
        """Write one frame.

        Args:
            depth: Shape (H, W), metres; NaN or <= 0: no return.
            row: What is known of the frame besides its images; not given after `like`.
            amplitude: Shape (H, W), not negative. All frames or none.
            mask: Shape (H, W), 0 or 1 (or bool), 1 on the target. All frames or none.
            raw: Correlation samples A0..A3, shape (4, H, W). All frames or none.
            true_depth: What an ideal camera would have measured, as `depth`. All frames or none.
            truth: A simulator's arrays of this frame, by name, any shape: `truth/NAME.npy` is
                their stack, in the type of the first.

        Raises:
            CalibrationDataError: A shape or value is not allowed, or the files cannot be written.
        """
        if (row is None) != (self._rows_from is not None):
            raise CalibrationDataError(
                f"{self.path}: frame {self._num_frames}: a row is needed for each frame, "
                "unless the rows are another recording's."
            )
        if row is not None:
            self._check_pose(row)
        size = (self._header.camera.height, self._header.camera.width)
        given = {"depth": depth, "amplitude": amplitude, "mask": mask, "raw": raw}
        given["true_depth"] = true_depth
        images: dict[str, _Image] = {}
        for name, array in IMAGE_ARRAYS.items():
            if given[name] is not None:
                frame = np.asarray(given[name])
                images[name] = _Image(frame, np.dtype(array.dtype), array.frame_shape(*size))
        for name, value in (truth or {}).items():
            frame = np.asarray(value)
            images[f"truth/{name}"] = _Image(frame, frame.dtype, frame.shape)
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
            # The reader's checks name the temporary folder.
            message = str(failure).replace(str(self._stage.folder), str(self.path))
            raise CalibrationDataError(message) from None
        finally:
            for stream in self._streams.values():
                stream.abandon()
            self._stage.discard()

    def _check_pose(self, row: FrameRow) -> None:
        """Refuse a pose that has no quaternion; the reader checks everything else."""
        try:
            refuse_unless_rigid(np.asarray(row.world_from_tool, dtype=np.float64))
        except ValueError as error:
            raise CalibrationDataError(
                f"{self.path}: frame {self._num_frames}, world_from_tool: {error}."
            ) from None

    def _write_images(self, images: Mapping[str, "_Image"]) -> None:
        if self._num_frames == 0:
            for name, image in images.items():
                file = self._stage.folder / f"{name}.npy"
                self._streams[name] = ArrayStream(file, image.dtype, image.shape)
        if images.keys() != self._streams.keys():
            differing = ", ".join(sorted(images.keys() ^ self._streams.keys()))
            raise CalibrationDataError(
                f"{self.path}: frame {self._num_frames}: {differing} must be given "
                "for all frames or for none."
            )
        frames = {}
        for name, image in images.items():
            where = f"{self.path}: frame {self._num_frames}, {name}"
            frames[name] = self._streams[name].convert(image.frame, where)
            check = IMAGE_ARRAYS[name].check_new if name in IMAGE_ARRAYS else None
            if check is not None:
                check(image.frame, where)
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
        # Amplitude and mask were checked when they were appended.
        Recording.open(folder, check_contents=False)


class _Image(NamedTuple):
    """One frame of one array, and the type and shape that all frames of the array have."""

    frame: np.ndarray
    dtype: np.dtype
    shape: tuple[int, ...]
