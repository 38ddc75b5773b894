"""A recording in memory, to be changed and written."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
from scipy.spatial.transform import Rotation

from tofcorr.data.recording import Recording
from tofcorr.data.table import FrameRow
from tofcorr.data.writing import write_recording


@dataclass(kw_only=True)
class Parts:
    """What a recording folder holds, as arrays; to be changed.

    Attributes:
        header: Keyword arguments of `write_recording` that are not arrays of frames.
        poses: world_from_tool, shape (N, 4, 4), metres.
        normal: Planes' normals, shape (N, 3).
        offset: Planes' offsets, shape (N,), metres.
        target: Names, shape (N,).
        timestamp: Seconds, shape (N,).
        depth: Shape (N, H, W), metres.
        amplitude: Shape (N, H, W); None: not recorded.
        mask: Shape (N, H, W); None: not recorded.
    """

    header: dict[str, Any]
    poses: np.ndarray
    normal: np.ndarray
    offset: np.ndarray
    target: np.ndarray
    timestamp: np.ndarray
    depth: np.ndarray
    amplitude: np.ndarray | None = None
    mask: np.ndarray | None = None

    @property
    def rotation(self) -> np.ndarray:
        """The rotations of the poses, shape (N, 3, 3), to be written to."""
        return self.poses[:, :3, :3]

    @property
    def place(self) -> np.ndarray:
        """The translations of the poses, shape (N, 3), metres, to be written to."""
        return self.poses[:, :3, 3]

    @classmethod
    def read(cls, folder: Path | str) -> Self:
        """Read a recording whole; conditions and pose ids are left out."""
        one = Recording.open(folder)
        return cls(
            header={
                "camera": one.camera,
                "depth_kind": one.depth_kind,
                "modulation_frequency": one.modulation_frequency,
                "saturation_amplitude": one.saturation_amplitude,
                "tool_from_camera": np.array(one.tool_from_camera),
                "planes": one.planes,
            },
            poses=one.frames.world_from_tool.copy(),
            normal=one.frames.normal_world.copy(),
            offset=one.frames.offset.copy(),
            target=one.frames.target.copy(),
            timestamp=one.frames.timestamp.copy(),
            depth=np.array(one.depth),
            amplitude=None if one.amplitude is None else np.array(one.amplitude),
            mask=None if one.mask is None else np.array(one.mask),
        )

    def changed(self, **parts: np.ndarray | None) -> Self:
        """Return a copy with other parts."""
        return replace(self, **parts)

    def with_header(self, **entries: object) -> Self:
        """Return a copy with other entries of the header."""
        return replace(self, header=self.header | entries)

    def frames(self, chosen: np.ndarray | slice) -> Self:
        """Return some frames, in this order."""
        names = ("poses", "normal", "offset", "target", "timestamp", "depth", "amplitude", "mask")
        arrays = {name: getattr(self, name) for name in names}
        return replace(self, **{name: a[chosen] for name, a in arrays.items() if a is not None})

    def write(self, folder: Path | str) -> Path:
        """Write the recording; nothing may be there yet."""
        columns = zip(
            self.timestamp.tolist(),
            self.poses,
            self.normal,
            self.offset.tolist(),
            self.target.tolist(),
            strict=True,
        )
        names = ("timestamp", "world_from_tool", "normal_world", "offset", "target")
        write_recording(
            folder,
            rows=[FrameRow(**dict(zip(names, row, strict=True))) for row in columns],
            depth=self.depth.astype(np.float32),
            amplitude=None if self.amplitude is None else self.amplitude.astype(np.float32),
            mask=None if self.mask is None else self.mask.astype(np.uint8),
            **self.header,
        )
        return Path(folder)


def drawn_rotation(degrees: float, generator: np.random.Generator) -> np.ndarray:
    """Return a rotation by this angle about a random axis, shape (3, 3)."""
    axis = generator.normal(size=3)
    return Rotation.from_rotvec(np.radians(degrees) * axis / np.linalg.norm(axis)).as_matrix()


def drawn_motion(metres: float, degrees: float, generator: np.random.Generator) -> np.ndarray:
    """Return a turn by this angle and a shift by this length, both at random, shape (4, 4)."""
    motion = np.eye(4)
    motion[:3, :3] = drawn_rotation(degrees, generator)
    step = generator.normal(size=3)
    motion[:3, 3] = metres * step / np.linalg.norm(step)
    return motion
