"""One recording folder: opened memory-mapped, and checked; which frames stood still."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np

from tofcorr.data import header, table
from tofcorr.data.arrays import IMAGE_ARRAYS, ImageArray, frame_chunks, open_array, read_frames
from tofcorr.data.header import DepthKind, PlaneOrigin
from tofcorr.data.table import COLUMN_OF, FrameTable, read_table
from tofcorr.errors import CalibrationDataError
from tofcorr.geometry.camera import CameraIntrinsics, FrameNames

_HEADER_KEY = {
    "modulation_frequency": "modulation_frequency_hz",
    "saturation_amplitude": "saturation_amplitude",
}
# Successive frames count as one pose if no entry of pose or plane differs from the first of them by
# more than this, metres or no unit. Chosen: a robot that stands still reports its joints to about
# 0.05 mm and 0.05 mrad.
_STANDSTILL = 5e-5


@dataclass(frozen=True, kw_only=True, eq=False)
class Recording:
    """A camera on a robot tool, or facing a known plane, looking at a flat target.

    Attributes:
        path: The folder.
        camera: The camera intrinsics.
        depth_kind: `radial`: along the viewing ray; `z`: along the optical axis.
        modulation_frequency: Hz; None if unknown.
        saturation_amplitude: Pixels at or above it are not used; None if unknown.
        tool_from_camera: The starting guess of the hand-eye transform, shape (4, 4).
        frames: What is known of each frame besides its images.
        depth: Shape (N, H, W), float32, metres; NaN or <= 0: no return. As the other images, it is
            memory-mapped in a recording that was opened.
        amplitude: Shape (N, H, W), float32, not negative; None if not recorded.
        mask: Shape (N, H, W), uint8, 1 on the target; None: 1 everywhere.
        raw: Correlation samples, shape (N, 4, H, W), float32; None if not recorded.
        true_depth: What an ideal camera would have measured, as `depth`; None: not rendered by a
            simulator, or not written. Nothing that fits or corrects reads it.
        planes: `recorded`: the planes of `frames` were measured by other means; `estimated`: an
            importer found them in the depth, they are a start for the fit and never truth.
        frame_names: What the robot calls its coordinate frames.
    """

    path: Path
    camera: CameraIntrinsics
    depth_kind: DepthKind
    modulation_frequency: float | None
    saturation_amplitude: float | None
    tool_from_camera: np.ndarray
    frames: FrameTable
    depth: np.ndarray
    amplitude: np.ndarray | None
    mask: np.ndarray | None
    raw: np.ndarray | None
    planes: PlaneOrigin
    frame_names: FrameNames
    true_depth: np.ndarray | None = None

    @classmethod
    def open(cls, path: Path | str, *, check_contents: bool = True) -> Self:
        """Open a recording and refuse it if it breaks the format.

        Args:
            path: The folder.
            check_contents: Also read amplitude and mask once, in small pieces, and refuse values
                that are not allowed. If False, `iterate_frames` checks each frame when it reads
                it: better for a recording that is larger than memory.

        Raises:
            CalibrationDataError: A file breaks the format; the message names file, field and frame.
        """
        path = Path(path)
        if not path.is_dir():
            found = f"is a file; a recording is a folder: {path.parent}" if path.is_file() else None
            raise CalibrationDataError(f"{path}: {found or 'there is no such folder'}.")
        head = header.read_header(path / header.FILE_NAME)
        frames = read_table(path / table.FILE_NAME)
        size = (head.camera.height, head.camera.width)
        recording = cls(
            path=path,
            camera=head.camera.intrinsics(),
            depth_kind=head.depth_kind,
            modulation_frequency=head.modulation_frequency_hz,
            saturation_amplitude=head.saturation_amplitude,
            tool_from_camera=head.tool_from_camera_matrix(),
            frames=frames,
            **{name: _opened(image, path, *size) for name, image in IMAGE_ARRAYS.items()},
            planes=head.planes,
            frame_names=head.frames,
        )
        recording._check_images(contents=check_contents)
        return recording

    def __repr__(self) -> str:
        """Say in one line what the recording holds."""
        present = [name for name in IMAGE_ARRAYS if getattr(self, name) is not None]
        return (
            f"Recording('{self.path}': {self.num_frames} frames of "
            f"{self.camera.width}x{self.camera.height} pixels, {self.depth_kind} depth; "
            f"arrays: {', '.join(present)})"
        )

    @property
    def num_frames(self) -> int:
        """Number of frames."""
        return len(self.frames)

    @property
    def moves(self) -> bool:
        """Whether a robot moved the camera; if not, the hand-eye transform is the identity."""
        return bool(np.any(self.frames.world_from_tool != np.eye(4)))

    def read(self, name: str, indices: np.ndarray) -> np.ndarray | None:
        """Copy frames of one array into memory, and check what they hold.

        Unlike `depth[indices]`, this does not make the file's pages count as memory of this
        process.

        Args:
            name: `depth`, `amplitude`, `mask`, `raw` or `true_depth`.
            indices: Which frames, in any order, shape (B,).

        Returns:
            Shape (B, ...), writable; None if the recording has no such array.

        Raises:
            CalibrationDataError: A frame holds a value that the format does not allow.
        """
        array = getattr(self, name)
        if array is None:
            return None
        frames = read_frames(array, indices)
        IMAGE_ARRAYS[name].check(frames, indices, self.path)
        return frames

    def require(self, name: str, needed_by: str) -> Any:  # noqa: ANN401 - array or number
        """Return something that a recording may lack, or refuse if it is missing.

        Args:
            name: An attribute of the recording or of its `frames`, such as `amplitude` or
                `integration_time`.
            needed_by: What needs it, for the message.

        Raises:
            CalibrationDataError: It is missing, or a frame's cell is empty.
        """
        holder = self.frames if name in COLUMN_OF else self
        value = getattr(holder, name)
        if value is None:
            raise CalibrationDataError(f"{self._where(name)} is missing; {needed_by} needs it.")
        if name in COLUMN_OF:
            empty = value == "" if name == "pose_id" else np.isnan(value)
            for frame in np.flatnonzero(empty)[:1]:
                raise CalibrationDataError(
                    f"{self._where(name)} is empty for frame {frame}; {needed_by} needs it."
                )
        return value

    def _where(self, name: str) -> str:
        if name in COLUMN_OF:
            return f"{self.path / table.FILE_NAME}: column '{COLUMN_OF[name]}'"
        if name in _HEADER_KEY:
            return f"{self.path / header.FILE_NAME}: '{_HEADER_KEY[name]}'"
        return f"{self.path}: {name}.npy"

    def _check_images(self, *, contents: bool) -> None:
        present = [name for name in IMAGE_ARRAYS if getattr(self, name) is not None]
        for name in present:
            if len(getattr(self, name)) != self.num_frames:
                raise CalibrationDataError(
                    f"{self.path / name}.npy: has {len(getattr(self, name))} frames; "
                    f"frames.csv has {self.num_frames} rows."
                )
        for name in present if contents else ():
            for indices in frame_chunks(self.num_frames, getattr(self, name)[:1].nbytes):
                self.read(name, indices)


def _opened(image: ImageArray, path: Path, height: int, width: int) -> Any:  # noqa: ANN401
    """Open an array of a recording; None stands for an optional one that is not there."""
    file = image.file(path)
    # is_symlink: a dangling link is a broken file, not a missing one.
    if image.required or file.exists() or file.is_symlink():
        return open_array(file, image.dtype, image.frame_shape(height, width))
    return None


def pose_numbers(recording: Recording) -> np.ndarray:
    """Return a number for each frame, shape (N,), int; frames taken without moving share it.

    Frames of one `pose_id` do. Frames without one do if they follow each other, a robot moves the
    camera, and the recorded pose, plane and target do not change.

    Args:
        recording: The recording.

    Returns:
        Numbers from 0 on, in the order of the first frame of each pose.
    """
    table, count = recording.frames, recording.num_frames
    place = np.concatenate(
        [table.world_from_tool.reshape(count, -1), table.normal_world, table.offset[:, None]],
        axis=1,
    )
    named = np.full(count, "") if table.pose_id is None else table.pose_id
    moves, numbers = recording.moves, dict[str, int]()
    pose, first = np.empty(count, dtype=int), 0
    for frame in range(count):
        # Compared with the first of the stretch: a slow robot moves less from frame to frame.
        # Nothing says that the target stood still where no pose is recorded.
        same = moves and np.abs(place[frame] - place[first]).max() <= _STANDSTILL
        if not (same and table.target[frame] == table.target[first]):
            first = frame
        name = f"pose {named[frame]}" if named[frame] != "" else f"stretch {first}"
        pose[frame] = numbers.setdefault(name, len(numbers))
    return pose
