"""One recording folder: header, images opened memory-mapped and checked, frames in batches."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
from pydantic import BeforeValidator
from torch import Tensor

from tofcorr.conditions import CONDITIONS
from tofcorr.data.arrays import IMAGE_ARRAYS, ImageArray, frame_chunks, open_array, read_frames
from tofcorr.data.table import COLUMN_OF, TABLE_FILE, FrameTable, read_table
from tofcorr.errors import CalibrationDataError
from tofcorr.geometry import se3
from tofcorr.geometry.camera import CameraIntrinsics, CameraSection, DepthKind, FrameNames
from tofcorr.geometry.rays import plane_in_frame, radial_distance_from_z_depth, ray_directions
from tofcorr.geometry.se3 import RigidTransform
from tofcorr.options import OpenOptions, PositiveNumber, not_a_truth_value, read_mapping

HEADER_FILE = "recording.yaml"
PlaneOrigin = Literal["recorded", "estimated"]
"""`recorded`: measured by other means; `estimated`: found in the depth itself, never truth."""


class Header(OpenOptions):
    """The content of `recording.yaml`; keys of other tools are ignored."""

    format: Literal["tofcorr-recording"]
    version: Annotated[Literal[1], BeforeValidator(not_a_truth_value)]
    camera: CameraSection
    depth_kind: DepthKind
    modulation_frequency_hz: PositiveNumber | None = None
    saturation_amplitude: PositiveNumber | None = None
    tool_from_camera: RigidTransform | None = None
    planes: PlaneOrigin = "recorded"
    frames: FrameNames = FrameNames()
    corrected_by: str | None = None

    def recording(self, path: Path, **content: Any) -> "Recording":  # noqa: ANN401
        """Return the recording with this header; `content` is its frames and images, if any."""
        mount = np.eye(4) if self.tool_from_camera is None else self.tool_from_camera
        return Recording(
            path=path,
            camera=self.camera.intrinsics(),
            depth_kind=self.depth_kind,
            modulation_frequency=self.modulation_frequency_hz,
            saturation_amplitude=self.saturation_amplitude,
            tool_from_camera=se3.nearest_rigid(np.array(mount, dtype=np.float64)),
            planes=self.planes,
            frame_names=self.frames,
            corrected_by=self.corrected_by,
            **content,
        )


def read_header(path: Path) -> Header:
    """Read and check `recording.yaml`.

    Raises:
        CalibrationDataError: The file is missing or breaks the format; the message names the key.
    """
    values = read_mapping(path, CalibrationDataError)
    absent = [key for key in Header.model_fields if key not in values]
    for key in values.keys() - Header.model_fields.keys():
        # Keys of other tools are allowed, unless one resembles a known key which is missing.
        for close in get_close_matches(str(key), absent, n=1, cutoff=0.8):
            said = f"'{key}' is not a known key. Did you mean '{close}'?"
            raise CalibrationDataError(f"{path}: {said}")
    return Header.from_mapping(values, str(path), CalibrationDataError)


STANDSTILL = 5e-5
"""Successive frames count as one pose if no entry of pose or plane differs from the first of them
by more than this, metres or no unit. Chosen: a robot that stands still reports its joints to about
0.05 mm and 0.05 mrad."""


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
        corrected_by: What corrected the depth; None: it is as the camera measured it.
    """

    path: Path
    camera: CameraIntrinsics
    depth_kind: DepthKind
    modulation_frequency: float | None = None
    saturation_amplitude: float | None = None
    tool_from_camera: np.ndarray = field(default_factory=lambda: np.eye(4))
    frames: FrameTable = None  # type: ignore[assignment] - a header alone has none
    depth: np.ndarray = None  # type: ignore[assignment]
    amplitude: np.ndarray | None = None
    mask: np.ndarray | None = None
    raw: np.ndarray | None = None
    planes: PlaneOrigin = "recorded"
    frame_names: FrameNames = field(default_factory=FrameNames)
    true_depth: np.ndarray | None = None
    corrected_by: str | None = None

    @staticmethod
    def open(path: Path | str, *, check_contents: bool = True) -> "Recording":
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
        head = read_header(path / HEADER_FILE)
        frames = read_table(path / TABLE_FILE)
        size = (head.camera.height, head.camera.width)
        images = {name: _opened(image, path, *size) for name, image in IMAGE_ARRAYS.items()}
        recording = head.recording(path, frames=frames, **images)
        recording._check_images(contents=check_contents)
        return recording

    @property
    def header(self) -> Header:
        """What `recording.yaml` says of it.

        Raises:
            CalibrationDataError: A value is not allowed.
        """
        values = {
            "format": "tofcorr-recording",
            "version": 1,
            "camera": self.camera.section(),
            "depth_kind": self.depth_kind,
            "modulation_frequency_hz": self.modulation_frequency,
            "saturation_amplitude": self.saturation_amplitude,
            "tool_from_camera": self.tool_from_camera.tolist(),
            "planes": self.planes,
            "frames": self.frame_names,
            "corrected_by": self.corrected_by,
        }
        return Header.from_mapping(values, HEADER_FILE, CalibrationDataError)

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
                where = f"{self._where(name)} is empty for frame {frame}"
                raise CalibrationDataError(f"{where}; {needed_by} needs it.")
        return value

    def _where(self, name: str) -> str:
        if name in COLUMN_OF:
            return f"{self.path / TABLE_FILE}: column '{COLUMN_OF[name]}'"
        key = f"{name}_hz" if name == "modulation_frequency" else name
        if key in Header.model_fields:
            return f"{self.path / HEADER_FILE}: '{key}'"
        return f"{self.path}: {name}.npy"

    def _check_images(self, *, contents: bool) -> None:
        present = [name for name in IMAGE_ARRAYS if getattr(self, name) is not None]
        for name in present:
            count = len(getattr(self, name))
            if count != self.num_frames:
                said = f"has {count} frames; frames.csv has {self.num_frames} rows"
                raise CalibrationDataError(f"{self.path / name}.npy: {said}.")
        for name in present if contents else ():
            pixels, every = self.camera.height * self.camera.width, np.arange(self.num_frames)
            for indices in frame_chunks(every, pixels, CHUNK_PIXELS):
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
    numbers, pose, first = dict[str, int](), np.empty(count, dtype=int), 0
    # Nothing says that the target stood still where no pose is recorded.
    steps = np.abs(np.diff(place, axis=0, prepend=place[:1])).max(axis=1)
    near = (steps <= 2 * STANDSTILL) & recording.moves
    for frame in range(count):
        # Compared with the first of the stretch: a slow robot moves less from frame to frame.
        same = near[frame] and np.abs(place[frame] - place[first]).max() <= STANDSTILL
        if not (same and table.target[frame] == table.target[first]):
            first = frame
        name = f"pose {named[frame]}" if named[frame] != "" else f"stretch {first}"
        pose[frame] = numbers.setdefault(name, len(numbers))
    return pose


def repeat_numbers(recording: Recording) -> np.ndarray:
    """Return a number for each frame, shape (N,), int; frames that differ by noise alone share it.

    They are of one pose, target and integration time: errors change with it, pixel by pixel.

    Returns:
        Numbers from 0 on, in the order of the first frame of each.
    """
    table = recording.frames
    _, target = np.unique(table.target, return_inverse=True)
    keys = np.column_stack([pose_numbers(recording), target])
    if table.integration_time is not None:
        keys = np.column_stack([keys, np.nan_to_num(table.integration_time)])
    _, first, number = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    return first.argsort().argsort()[number]


def repeats_of(recording: Recording) -> list[np.ndarray]:
    """Return the frames of each set of repeats, in the order of the first frame of each."""
    numbers = repeat_numbers(recording)
    return [np.flatnonzero(numbers == number) for number in range(numbers.max() + 1)]


@dataclass(frozen=True, kw_only=True, eq=False)
class FrameBatch:
    """Some frames of a recording.

    Attributes:
        indices: Which frames, shape (B,), int64.
        radial_distance: Measured distance along the ray whatever the recording's `depth_kind`,
            shape (B, H, W), metres; undefined where not `valid`.
        amplitude: Counts, shape (B, H, W); None if not recorded.
        valid: Where a pixel may be used, shape (B, H, W), bool.
        normal_tool: Unit normal of the target's plane in the tool frame, shape (B, 3).
        offset_tool: Its offset d in n . x + d = 0, shape (B,), metres.
        conditions: Conditions in the order of `CONDITIONS`, shape (B, C), NaN where unknown; None
            if the batch was built without them.
    """

    indices: Tensor
    radial_distance: Tensor
    amplitude: Tensor | None
    valid: Tensor
    normal_tool: Tensor
    offset_tool: Tensor
    conditions: Tensor | None = None


CHUNK_PIXELS = 131_072
"""Pixels that are read at once: a few megabytes. Set by timing on VGA recordings."""


def iterate_frames(
    recording: Recording,
    indices: Sequence[int] | np.ndarray | None = None,
    chunk_pixels: int = CHUNK_PIXELS,
    device: torch.device | str = "cpu",
    image_dtype: torch.dtype = torch.float64,
) -> Iterator[FrameBatch]:
    """Yield frames in batches of bounded size, read from disk as they are needed.

    Args:
        recording: The recording.
        indices: Which frames, in this order, repeats allowed; None: all.
        chunk_pixels: Largest number of pixels per batch, but at least one frame.
        device: Of all tensors.
        image_dtype: Of distance and amplitude. Radial distances and amplitudes are recorded in
            float32, which holds them without loss; planes and conditions are of float64.

    Yields:
        Batches that together contain every chosen frame, in order.

    Raises:
        CalibrationDataError: A frame holds a value that the format does not allow.
        IndexError: There is no such frame.
    """
    chosen = np.arange(recording.num_frames)
    if indices is not None:
        chosen = np.asarray(indices, dtype=np.int64).reshape(-1)
    for wrong in chosen[(chosen < 0) | (chosen >= recording.num_frames)][:1]:
        raise IndexError(f"there is no frame {wrong}: the recording has {recording.num_frames}.")
    camera = recording.camera
    normals, offsets = planes_in_tool(recording)
    conditions = frame_conditions(recording.frames)
    rays = None
    if recording.depth_kind == "z":
        rays = ray_directions(camera).to(device=device, dtype=image_dtype)
    for chunk in frame_chunks(chosen, camera.height * camera.width, chunk_pixels):
        depth = recording.read("depth", chunk)
        assert depth is not None
        distance = torch.from_numpy(depth).to(device, image_dtype)
        if rays is not None:
            distance = radial_distance_from_z_depth(distance, rays)
        amplitude, mask = (recording.read(name, chunk) for name in ("amplitude", "mask"))
        if amplitude is not None:
            amplitude = torch.from_numpy(amplitude).to(device, image_dtype)
        if mask is not None:
            mask = torch.from_numpy(mask).to(device)
        yield FrameBatch(
            indices=torch.from_numpy(chunk).to(device),
            radial_distance=distance,
            amplitude=amplitude,
            valid=valid_pixels(distance, amplitude, mask, recording.saturation_amplitude),
            normal_tool=normals[chunk].to(device),
            offset_tool=offsets[chunk].to(device),
            conditions=conditions[chunk].to(device),
        )


def valid_pixels(
    distance: Tensor,
    amplitude: Tensor | None = None,
    mask: Tensor | None = None,
    saturation_amplitude: float | None = None,
) -> Tensor:
    """Return True where a pixel holds a usable measurement of the target.

    A pixel is usable if its distance is finite and positive (NaN or <= 0 means "no return"), it
    sees the target, and its amplitude, if recorded, is finite and below saturation.

    Args:
        distance: Measured distances of either kind, shape (..., H, W), metres.
        amplitude: Amplitudes, shape of `distance`; None if unknown.
        mask: Non-zero where the pixel sees the target, shape of `distance`; None: everywhere.
        saturation_amplitude: Pixels at or above it are not used; None if unknown.

    Returns:
        Shape of `distance`, bool.
    """
    # Zero times NaN or infinity is NaN, above which nothing lies. Comparisons are not vectorised:
    # they take three times as long as the arithmetic.
    zero = distance * 0.0
    if amplitude is not None:
        zero.add_(amplitude, alpha=0.0)
    valid = distance > zero
    if amplitude is not None and saturation_amplitude is not None:
        valid &= amplitude < saturation_amplitude
    if mask is not None:
        valid &= mask.bool()
    return valid


def frame_conditions(table: FrameTable) -> Tensor:
    """Return the conditions of every frame (N, C) in the order of `CONDITIONS`; NaN: unknown."""
    columns = [getattr(table, name) for name in CONDITIONS]
    unknown = np.full(len(table), np.nan)
    known = [unknown if column is None else column for column in columns]
    return torch.from_numpy(np.stack(known, axis=1).astype(np.float64))


def planes_in_tool(recording: Recording) -> tuple[Tensor, Tensor]:
    """Return the target's plane in the tool frame: normals (N, 3), offsets (N,), float64."""
    names = "normal_world", "offset", "world_from_tool"
    return plane_in_frame(*(torch.from_numpy(getattr(recording.frames, name)) for name in names))
