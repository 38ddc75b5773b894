"""Recordings written frame by frame, whole or not at all; with corrected depth; as point clouds."""

import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor

from tofcorr.data.arrays import IMAGE_ARRAYS, ArrayStream, frame_chunks, read_frames
from tofcorr.data.recording import HEADER_FILE, DepthKind, Header, PlaneOrigin, Recording
from tofcorr.data.table import TABLE_FILE, FrameRow, FrameTable, table_text
from tofcorr.errors import CalibrationDataError
from tofcorr.files import staged_folder, writing_to
from tofcorr.geometry.camera import CameraIntrinsics, FrameNames
from tofcorr.geometry.rays import ray_directions
from tofcorr.geometry.se3 import refuse_unless_rigid
from tofcorr.options import dump_yaml
from tofcorr.progress import bar
from tofcorr.version import __version__


class RecordingWriter:
    """Writes a recording frame by frame; the folder appears when the block ends without an error.

    Until then the files are in a hidden folder beside it, which `tofcorr watch` finds. No reader
    takes it for a recording: its arrays say that they hold no frame. Any exception, Ctrl-C
    included, removes that folder. Nothing is overwritten. The checks of `Recording.open` are
    applied to all files.

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
        mount = np.eye(4) if tool_from_camera is None else np.asarray(tool_from_camera)
        self._header = Recording(
            path=Path(path),
            camera=camera,
            depth_kind=depth_kind,
            modulation_frequency=modulation_frequency,
            saturation_amplitude=saturation_amplitude,
            tool_from_camera=mount,
            planes=planes,
            frame_names=frame_names or FrameNames(),
        ).header
        self._rows: list[FrameRow] = []
        self._rows_from: Path | None = None
        self._num_frames = 0
        self._streams: dict[str, ArrayStream] = {}
        self.path = Path(path)
        self._stack = ExitStack()
        self._folder = self._stack.enter_context(staged_folder(path))

    @classmethod
    def like(
        cls,
        path: Path | str,
        recording: Recording,
        *,
        corrected_by: str | None = None,
        rows: bool = True,
    ) -> Self:
        """Begin a recording with the header and the rows of another one; its images are appended.

        Args:
            path: The folder to write.
            recording: The other one.
            corrected_by: What corrects the depth; None: as that of `recording`.
            rows: Whether `frames.csv` is copied unchanged, with the columns of other tools.
                `append` then takes no row, and as many frames must be appended as `recording` has.
        """
        writer = cls(path, camera=recording.camera, depth_kind=recording.depth_kind)
        corrected_by = corrected_by or recording.corrected_by
        writer._header = replace(recording, corrected_by=corrected_by).header
        writer._rows_from = recording.path / TABLE_FILE if rows else None
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
            raise CalibrationDataError(f"{self._here()}: expected a row, or none after `like`.")
        if row is not None:
            self._check_pose(row)
        given = {"depth": depth, "amplitude": amplitude, "mask": mask, "raw": raw}
        given |= {"true_depth": true_depth}
        given |= {f"truth/{name}": value for name, value in (truth or {}).items()}
        images = {name: np.asarray(v) for name, v in given.items() if v is not None}
        with writing_to(self.path):
            self._write_images(images)
        if row is not None:
            self._rows.append(row)
            text = table_text([row], self._num_frames)
            # Last of all: who watches the frames come takes one when its row is there.
            with writing_to(self.path), (self._folder / TABLE_FILE).open("ab") as table:
                table.write(text.encode())
        self._num_frames += 1

    def add_truth(self, name: str, value: Mapping[str, Any]) -> None:
        """Write `truth/NAME.yaml`, keys and values."""
        folder = self._folder / "truth"
        with writing_to(self.path):
            folder.mkdir(exist_ok=True)
            (folder / f"{name}.yaml").write_text(dump_yaml(value), encoding="utf-8")

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
        with self._stack:
            if error is not None:
                raise error
            with writing_to(self.path):
                self._finish()

    def _here(self) -> str:
        return f"{self.path}: frame {self._num_frames}"

    def _check_pose(self, row: FrameRow) -> None:
        """Refuse a pose that has no quaternion; the reader checks everything else."""
        try:
            pose = np.asarray(row.world_from_tool, dtype=np.float64)
            refuse_unless_rigid(pose)
        except ValueError as error:
            raise CalibrationDataError(f"{self._here()}, world_from_tool: {error}.") from None

    def _write_images(self, images: Mapping[str, np.ndarray]) -> None:
        if self._num_frames == 0:
            self._write_header()
            size = (self._header.camera.height, self._header.camera.width)
            for name, image in images.items():
                known, file = IMAGE_ARRAYS.get(name), self._folder / f"{name}.npy"
                shape = known.frame_shape(*size) if known else image.shape
                dtype = np.dtype(known.dtype) if known else image.dtype
                self._streams[name] = ArrayStream(file, dtype, shape)
                self._stack.callback(self._streams[name].abandon)
        if images.keys() != self._streams.keys():
            differing = ", ".join(sorted(images.keys() ^ self._streams.keys()))
            raise CalibrationDataError(f"{self._here()}: give {differing} in all frames or none.")
        frames = {}
        for name, image in images.items():
            frames[name] = self._streams[name].convert(image, f"{self._here()}, {name}")
            if name in IMAGE_ARRAYS:
                IMAGE_ARRAYS[name].check(frames[name][None], [self._num_frames], self.path)
        for name, frame in frames.items():
            self._streams[name].write(frame)

    def _write_header(self) -> None:
        header = self._header.to_mapping()
        for key in ("planes", "frames", "corrected_by"):  # Only where they say more.
            if getattr(self._header, key) == Header.model_fields[key].default:
                del header[key]
        text = dump_yaml(header, last="depth_kind")
        (self._folder / HEADER_FILE).write_text(text, encoding="utf-8")

    def _finish(self) -> None:
        for stream in self._streams.values():
            stream.finish(self._num_frames)
        folder = self._folder
        if not self._num_frames:
            self._write_header()
        if self._rows_from is not None:
            shutil.copyfile(self._rows_from, folder / TABLE_FILE)
        else:
            rows = table_text(self._rows)
            (folder / TABLE_FILE).write_text(rows, encoding="utf-8", newline="")
        try:
            # Images were checked when they were appended.
            Recording.open(folder, check_contents=False)
        except CalibrationDataError as failure:  # It names the temporary folder.
            message = str(failure).replace(str(folder), str(self.path))
            raise CalibrationDataError(message) from None


def write_recording(
    path: Path | str,
    *,
    rows: FrameTable | Iterable[FrameRow],
    **given: Any,  # noqa: ANN401 - as for RecordingWriter
) -> None:
    """Write a recording whose arrays are in memory or memory-mapped.

    The first axis of each array (`depth`, `amplitude`, `mask`, `raw`) is the frame. The
    other arguments and the errors are those of `RecordingWriter`.
    """
    rows = rows.rows() if isinstance(rows, FrameTable) else list(rows)
    images = {name: given.pop(name, None) for name in IMAGE_ARRAYS}
    images = {name: array for name, array in images.items() if array is not None}
    for name, array in images.items():
        if len(array) != len(rows):
            raise CalibrationDataError(f"{path}: {len(array)} frames of {name}, {len(rows)} rows.")
    with RecordingWriter(path, **given) as writer:
        for frame, row in enumerate(rows):
            writer.append(row=row, **{name: array[frame] for name, array in images.items()})


Corrector = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
"""Takes depth and amplitude, shape (B, H, W), float32, and returns corrected depth and where it is
valid. Amplitudes are NaN where a recording has none."""

_PLY_TYPES = {"float32": "float", "uint8": "uchar"}
_AXES = "camera frame, metres: x right, y down, z forward (optical frame of REP 103)"


def write_corrected(
    corrector: Corrector, recording: Recording, path: Path | str, *, chunk_pixels: int = 2_000_000
) -> float:
    """Write a copy of `recording` with corrected depth, in memory bounded by `chunk_pixels`.

    Rows, header and amplitude are copied. The mask is 1 where that of `recording` is 1 and the
    correction is valid. Raw samples are left out: they would contradict the depth.

    Args:
        corrector: What corrects.
        recording: The recording to correct.
        path: The folder to write; it must not exist yet.
        chunk_pixels: Pixels corrected at once, but at least one frame.

    Returns:
        The share of the pixels on the target with a return that are in the calibrated range.

    Raises:
        CalibrationDataError: `path` exists, cannot be written, or `recording` is broken or was
            corrected already.
    """
    num_returns = num_valid = 0
    by = f"tofcorr {__version__}"
    with RecordingWriter.like(path, recording, corrected_by=by) as writer, torch.inference_mode():
        frames = _frames(corrector, recording, chunk_pixels)
        for depth, amplitude, on_target, corrected, kept in frames:
            for i, frame in enumerate(corrected):
                strength = None if amplitude is None else amplitude[i]
                writer.append(frame, amplitude=strength, mask=kept[i])
            num_returns += int((_returned(depth) & on_target).sum())
            num_valid += int(kept.sum())
    return num_valid / max(1, num_returns)


def write_point_clouds(corrector: Corrector, recording: Recording, path: Path | str) -> None:
    """Write `frame_000_before.ply` and `frame_000_after.ply` for each frame of a recording.

    A pixel without a return is not a point. Points have `amplitude` where it was recorded; after
    correction, `valid` is 1 inside the calibrated range and on the target.

    Args:
        corrector: What corrects.
        recording: What to correct.
        path: The folder, which must not exist yet.

    Raises:
        CalibrationDataError: `path` exists, the disk refuses, or `recording` is broken or was
            corrected already.
    """
    rays = ray_directions(recording.camera)
    directions = (rays / rays[..., 2:] if recording.depth_kind == "z" else rays).numpy()
    digits = max(3, len(str(recording.num_frames - 1)))
    with staged_folder(path) as folder, torch.inference_mode():
        frames = _frames(corrector, recording, 1)
        for number, (depth, amplitude, _, corrected, kept) in enumerate(frames):
            name = folder / f"frame_{number:0{digits}d}"
            more = {} if amplitude is None else {"amplitude": amplitude[0]}
            _write_points(Path(f"{name}_before.ply"), depth[0], directions, more)
            more["valid"] = kept[0].astype(np.uint8)
            _write_points(Path(f"{name}_after.ply"), corrected[0], directions, more)


def _frames(
    corrector: Corrector, recording: Recording, most: int
) -> Iterator[tuple[np.ndarray, np.ndarray | None, np.ndarray, np.ndarray, np.ndarray]]:
    """Yield the frames of a recording in order, by so many pixels, and show how many have passed.

    Yields:
        Depth as recorded; amplitude as recorded, or None; where a pixel looks at the target;
        corrected depth; where the correction is valid on the target: each of shape (B, H, W).
    """
    if recording.corrected_by is not None:
        said = f"its depth was corrected already, by {recording.corrected_by}"
        advice = "correct the recording that it was made from"
        raise CalibrationDataError(f"{recording.path}: {said}; {advice}.")
    with bar(recording.num_frames, "correcting") as advance:
        pixels, every = recording.depth[0].size, np.arange(recording.num_frames)
        for chunk in frame_chunks(every, pixels, most):
            depth = read_frames(recording.depth, chunk)
            amplitude, mask = (recording.read(name, chunk) for name in ("amplitude", "mask"))
            on_target = np.ones(depth.shape, dtype=bool) if mask is None else mask == 1
            given = np.full_like(depth, np.nan) if amplitude is None else amplitude
            if (set_pose := getattr(corrector, "set_pose", None)) is not None:
                set_pose(recording.frames.world_from_tool[chunk])
            corrected, valid = corrector(torch.from_numpy(depth), torch.from_numpy(given))
            yield depth, amplitude, on_target, corrected.numpy(), on_target & valid.numpy()
            advance(len(chunk))


def _returned(depth: np.ndarray) -> np.ndarray:
    return np.isfinite(depth) & (depth > 0)


def _write_points(
    path: Path, depth: np.ndarray, directions: np.ndarray, more: Mapping[str, np.ndarray]
) -> None:
    """Write the points of an image (H, W) with further properties (H, W), as binary PLY."""
    seen = _returned(depth)
    points = (directions[seen] * depth[seen][:, None].astype(np.float64)).astype(np.float32)
    columns = {axis: points[:, k] for k, axis in enumerate("xyz")}
    columns |= {name: image[seen] for name, image in more.items()}
    kinds = [(name, values.dtype.newbyteorder("<")) for name, values in columns.items()]
    table = np.rec.fromarrays(list(columns.values()), dtype=kinds)
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment {_AXES}",
        f"element vertex {len(table)}",
        *(f"property {_PLY_TYPES[values.dtype.name]} {name}" for name, values in columns.items()),
        "end_header",
    ]
    path.write_bytes(("\n".join(header) + "\n").encode("ascii") + table.tobytes())
