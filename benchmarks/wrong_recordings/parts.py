"""A recording in memory, to be changed and written."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.renewed.geometry import transforms
from tofcorr.data.recording import Recording
from tofcorr.data.table import FrameTable
from tofcorr.data.writing import write_recording

HEADER = (
    *("camera", "depth_kind", "modulation_frequency", "saturation_amplitude"),
    *("tool_from_camera", "planes"),
)
COLUMNS = {
    "poses": "world_from_tool",
    "normal": "normal_world",
    **{name: name for name in ("offset", "target", "timestamp")},
}
IMAGES = {"depth": np.float32, "amplitude": np.float32, "mask": np.uint8}


@dataclass(kw_only=True)
class Parts:
    """What a recording folder holds, as arrays; images may be changed in place.

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
        """The rotations of the poses, shape (N, 3, 3)."""
        return self.poses[:, :3, :3]

    @property
    def place(self) -> np.ndarray:
        """The translations of the poses, shape (N, 3), metres."""
        return self.poses[:, :3, 3]

    @classmethod
    def read(cls, folder: Path | str) -> Self:
        """Read a recording whole; conditions and pose ids are left out."""
        one = Recording.open(folder)
        parts: dict[str, Any] = {own: getattr(one.frames, name) for own, name in COLUMNS.items()}
        parts |= {name: one.read(name, np.arange(one.num_frames)) for name in IMAGES}
        return cls(header={name: getattr(one, name) for name in HEADER}, **parts)

    def changed(self, **parts: Any) -> Self:  # noqa: ANN401 - arrays, or entries of the header
        """Return a copy with other parts: fields, `place`, `rotation`, or entries of the header."""
        poses = np.array(parts.pop("poses", self.poses))
        poses[:, :3, 3] = parts.pop("place", poses[:, :3, 3])
        poses[:, :3, :3] = parts.pop("rotation", poses[:, :3, :3])
        header = {name: parts.pop(name) for name in HEADER if name in parts}
        return replace(self, poses=poses, header=self.header | header, **parts)

    def frames(self, chosen: np.ndarray | slice) -> Self:
        """Return some frames, in this order."""
        arrays = {name: getattr(self, name) for name in (*COLUMNS, *IMAGES)}
        return replace(self, **{name: a[chosen] for name, a in arrays.items() if a is not None})

    def write(self, folder: Path | str) -> Path:
        """Write the recording; nothing may be there yet."""
        rows = FrameTable(**{name: getattr(self, own) for own, name in COLUMNS.items()})
        given = {name: (getattr(self, name), kind) for name, kind in IMAGES.items()}
        images: Any = {k: None if a is None else a.astype(kind) for k, (a, kind) in given.items()}
        write_recording(folder, rows=rows, **images, **self.header)
        return Path(folder)


def drawn_rotation(degrees: float, generator: np.random.Generator) -> np.ndarray:
    """Return a rotation by this angle about a random axis, shape (3, 3)."""
    axis = generator.normal(size=3)
    return Rotation.from_rotvec(np.radians(degrees) * axis / np.linalg.norm(axis)).as_matrix()


def drawn_motion(metres: float, degrees: float, generator: np.random.Generator) -> np.ndarray:
    """Return a turn by this angle and a shift by this length, both at random, shape (4, 4)."""
    rotation, step = drawn_rotation(degrees, generator), generator.normal(size=3)
    return transforms(rotation, metres * step / np.linalg.norm(step))
