"""A recording in memory, to be changed and written."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np

from tofcorr.data.recording import Recording
from tofcorr.data.table import FrameRow
from tofcorr.data.writing import write_recording


@dataclass(frozen=True, kw_only=True)
class Parts:
    """What a recording folder holds, as arrays; a fault returns a changed copy.

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
        rows = [
            FrameRow(
                timestamp=float(self.timestamp[k]),
                world_from_tool=self.poses[k],
                normal_world=self.normal[k],
                offset=float(self.offset[k]),
                target=str(self.target[k]),
            )
            for k in range(len(self.poses))
        ]
        write_recording(
            folder,
            rows=rows,
            depth=self.depth.astype(np.float32),
            amplitude=None if self.amplitude is None else self.amplitude.astype(np.float32),
            mask=None if self.mask is None else self.mask.astype(np.uint8),
            **self.header,
        )
        return Path(folder)
