"""One recording folder: opened memory-mapped, and checked."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np

from tofcorr.data import arrays, columns, header
from tofcorr.data.header import DepthKind
from tofcorr.data.table import FrameTable
from tofcorr.data.table_reading import read_table
from tofcorr.errors import CalibrationDataError
from tofcorr.geometry.intrinsics import CameraIntrinsics

_CONTENT_CHECKS = {"amplitude": arrays.check_amplitude, "mask": arrays.check_mask}
_HEADER_KEY = {
    "modulation_frequency": "modulation_frequency_hz",
    "saturation_amplitude": "saturation_amplitude",
}


@dataclass(frozen=True, kw_only=True, eq=False)
class Recording:
    """A camera on a robot tool, or facing a known plane, looking at a flat target.

    Attributes:
        path: The folder.
        camera: The lateral parameters.
        depth_kind: `radial`: along the viewing ray; `z`: along the optical axis.
        modulation_frequency: Hz; None if unknown.
        saturation_amplitude: Pixels at or above it are not used; None if unknown.
        tool_from_camera: The starting guess of the hand-eye transform, shape (4, 4).
        frames: What is known of each frame.
        depth: Memory-mapped, shape (N, H, W), float32, metres; NaN or <= 0: no return.
        amplitude: Memory-mapped, shape (N, H, W), float32, not negative; None if not recorded.
        mask: Memory-mapped, shape (N, H, W), uint8, 1 on the target; None: all pixels are.
        raw: Memory-mapped correlation samples, shape (N, 4, H, W), float32; None if not recorded.
    """

    path: Path
    camera: CameraIntrinsics
    depth_kind: DepthKind
    modulation_frequency: float | None
    saturation_amplitude: float | None
    tool_from_camera: np.ndarray
    frames: FrameTable
    depth: np.memmap
    amplitude: np.memmap | None
    mask: np.memmap | None
    raw: np.memmap | None

    @classmethod
    def open(cls, path: Path | str, *, check_contents: bool = True) -> Self:
        """Open a recording and refuse it if it breaks the format.

        Args:
            path: The folder.
            check_contents: Also read amplitude and mask once, in small pieces, for values that
                are not allowed. Without it they are checked when `iterate_frames` comes to them:
                right for a recording that is larger than memory and streamed anyhow.

        Raises:
            CalibrationDataError: The format is broken; the message names file, field and frame.
        """
        path = Path(path)
        if not path.is_dir():
            raise CalibrationDataError(f"{path}: there is no such folder.")
        head = header.read_header(path / header.FILE_NAME)
        frames = read_table(path / columns.FILE_NAME)
        size = (head.camera.height, head.camera.width)
        depth = arrays.open_array(path / "depth.npy", np.float32, size)
        recording = cls(
            path=path,
            camera=head.intrinsics(),
            depth_kind=head.depth_kind,
            modulation_frequency=head.modulation_frequency_hz,
            saturation_amplitude=head.saturation_amplitude,
            tool_from_camera=head.tool_from_camera_matrix(),
            frames=frames,
            depth=depth,
            amplitude=_open_optional(path / "amplitude.npy", np.float32, size),
            mask=_open_optional(path / "mask.npy", np.uint8, size),
            raw=_open_optional(path / "raw.npy", np.float32, (4, *size)),
        )
        recording._check_lengths()
        if check_contents:
            recording._check_contents()
        return recording

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

        Other than `depth[indices]`, this does not make the file's pages count as memory of this
        process.

        Args:
            name: `depth`, `amplitude`, `mask` or `raw`.
            indices: Which frames, in any order, shape (B,).

        Returns:
            Shape (B, ...), writable; None if the recording has no such array.

        Raises:
            CalibrationDataError: A frame holds a value that the format does not allow.
        """
        array = getattr(self, name)
        if array is None:
            return None
        frames = arrays.read_frames(array, indices)
        if name in _CONTENT_CHECKS:
            _CONTENT_CHECKS[name](frames, indices, self.path / f"{name}.npy")
        return frames

    def require(self, name: str, needed_by: str) -> Any:  # noqa: ANN401 - array or number
        """Return an optional part of the recording, or refuse for want of it.

        Args:
            name: An attribute of the recording or of its `frames`, such as `amplitude` or
                `integration_time`.
            needed_by: What cannot do without it, for the message.

        Raises:
            CalibrationDataError: The part is missing, or a frame's cell is empty.
        """
        holder = self.frames if name in columns.COLUMN_OF else self
        value = getattr(holder, name)
        if value is None:
            raise CalibrationDataError(f"{self._where(name)} is missing; {needed_by} needs it.")
        if name in columns.COLUMN_OF:
            empty = value == "" if name == "pose_id" else np.isnan(value)
            for frame in np.flatnonzero(empty)[:1]:
                raise CalibrationDataError(
                    f"{self._where(name)} is empty for frame {frame}; {needed_by} needs it."
                )
        return value

    def _where(self, name: str) -> str:
        if name in columns.COLUMN_OF:
            return f"{self.path / columns.FILE_NAME}: column '{columns.COLUMN_OF[name]}'"
        if name in _HEADER_KEY:
            return f"{self.path / header.FILE_NAME}: '{_HEADER_KEY[name]}'"
        return f"{self.path}: {name}.npy"

    def _check_lengths(self) -> None:
        for name in ("depth", "amplitude", "mask", "raw"):
            array = getattr(self, name)
            if array is not None and len(array) != self.num_frames:
                raise CalibrationDataError(
                    f"{self.path / name}.npy: has {len(array)} frames; "
                    f"frames.csv has {self.num_frames} rows."
                )

    def _check_contents(self) -> None:
        for name in _CONTENT_CHECKS:
            array = getattr(self, name)
            if array is not None:
                for indices in arrays.frame_chunks(self.num_frames, array[:1].nbytes):
                    self.read(name, indices)


def _open_optional(
    path: Path, dtype: type[np.generic], frame_shape: tuple[int, ...]
) -> np.memmap | None:
    # A dangling link is a broken file, not a missing one: is_symlink keeps it from passing as such.
    if not path.exists() and not path.is_symlink():
        return None
    return arrays.open_array(path, dtype, frame_shape)
