"""Writing a recording whose arrays are all there already."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from tofcorr.data.header import DepthKind, PlaneOrigin
from tofcorr.data.table import FrameRow, FrameTable
from tofcorr.data.writing import RecordingWriter
from tofcorr.errors import CalibrationDataError
from tofcorr.geometry.frame_names import FrameNames
from tofcorr.geometry.intrinsics import CameraIntrinsics


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
    planes: PlaneOrigin = "recorded",
    frame_names: FrameNames | None = None,
    truth: Mapping[str, np.ndarray | Mapping[str, Any]] | None = None,
) -> None:
    """Write a recording whose arrays are in memory or memory-mapped.

    The first axis of each array is the frame. `truth` goes to `truth/`, arrays as `.npy` and
    mappings as `.yaml`. The other arguments and the errors are those of `RecordingWriter`.
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
        planes=planes,
        frame_names=frame_names,
    ) as writer:
        for frame, row in enumerate(rows):
            writer.append(
                depth[frame], row=row, **{name: array[frame] for name, array in given.items()}
            )
        for name, value in (truth or {}).items():
            writer.add_truth(name, value)
