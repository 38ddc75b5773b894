"""Recording folders, version 1, written with NumPy and plain text."""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks.withheld.generator.recording import Recorded
from benchmarks.withheld.generator.rigid import quaternions

OPTIONAL_COLUMNS = (
    "pose_id",
    "integration_time_us",
    "body_temperature_c",
    "room_temperature_c",
    "ambient",
)
WITHHOLDABLE = (*OPTIONAL_COLUMNS, "amplitude.npy", "modulation_frequency_hz")


def write_recording(
    folder: Path, recorded: Recorded, withhold: frozenset[str] = frozenset()
) -> None:
    """Write a recording, without the columns, files or fields named in `withhold`."""
    if unknown := withhold - set(WITHHOLDABLE):
        raise ValueError(
            f"cannot withhold {sorted(unknown)}: expected some of {', '.join(WITHHOLDABLE)}"
        )
    folder.mkdir(parents=True)
    np.save(folder / "depth.npy", recorded.depth.astype(np.float32))
    np.save(folder / "mask.npy", recorded.mask.astype(np.uint8))
    if "amplitude.npy" not in withhold:
        np.save(folder / "amplitude.npy", recorded.amplitude.astype(np.float32))
    (folder / "frames.csv").write_text(_frames(recorded, withhold))
    (folder / "recording.yaml").write_text(_description(recorded, withhold))


def _description(recorded: Recorded, withhold: frozenset[str]) -> str:
    """recording.yaml in YAML's flow style, which is JSON."""
    camera = recorded.world.camera
    frequency = None if "modulation_frequency_hz" in withhold else camera.modulation_frequency
    entries = {
        "format": "tofcorr-recording",
        "version": 1,
        "camera": {
            "width": camera.width,
            "height": camera.height,
            "K": camera.matrix,
            "distortion": [float(number) for number in camera.distortion],
        },
        "depth_kind": "radial",
        "modulation_frequency_hz": frequency,
        "saturation_amplitude": None,
        "tool_from_camera": recorded.world.setup.tool_from_camera_guess.tolist(),
    }
    return "".join(f"{key}: {json.dumps(value)}\n" for key, value in entries.items())


def _frames(recorded: Recorded, withhold: frozenset[str]) -> str:
    world, poses = recorded.world, recorded.stated_poses
    normal = world.setup.world_from_target[:3, 2]
    offset = -normal @ world.setup.world_from_target[:3, 3]
    conditions, n = world.conditions, world.frames
    columns: dict[str, Sequence[str] | np.ndarray] = {
        "frame": np.arange(n),
        "timestamp_s": world.trajectory.timestamps,
    }
    columns |= dict(zip(("tx", "ty", "tz"), poses[:, :3, 3].T, strict=True))
    columns |= dict(zip(("qx", "qy", "qz", "qw"), quaternions(poses[:, :3, :3]).T, strict=True))
    columns |= {
        name: np.full(n, value) for name, value in zip(("nx", "ny", "nz"), normal, strict=True)
    }
    columns |= {
        "d": np.full(n, offset),
        "target": ["checkerboard" if board else "white" for board in world.target.checkerboard],
        "pose_id": world.trajectory.pose_id,
        "integration_time_us": conditions.exposure,
        "body_temperature_c": conditions.body_temperature,
        "room_temperature_c": conditions.room_temperature,
        "ambient": conditions.ambient,
    }
    if world.design.moving:
        del columns["pose_id"]  # no two frames stand still together
    kept = {name: values for name, values in columns.items() if name not in withhold}
    rows = zip(*([_cell(value) for value in values] for values in kept.values()), strict=True)
    return "\n".join([",".join(kept), *(",".join(row) for row in rows)]) + "\n"


def _cell(value: object) -> str:
    return f"{value:.9g}" if isinstance(value, np.floating) else str(value)
