"""Recording folders, version 1, written with NumPy and plain text."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.renewed.generator.recording import Recorded
from benchmarks.withheld.generator.rigid import quaternions


def write_recording(folder: Path, recorded: Recorded) -> None:
    """Write a recording."""
    folder.mkdir(parents=True)
    np.save(folder / "depth.npy", recorded.depth.astype(np.float32))
    np.save(folder / "mask.npy", recorded.mask.astype(np.uint8))
    np.save(folder / "amplitude.npy", recorded.amplitude.astype(np.float32))
    (folder / "frames.csv").write_text(_frames(recorded))
    (folder / "recording.yaml").write_text(_description(recorded))


def _description(recorded: Recorded) -> str:
    """recording.yaml in YAML's flow style, which is JSON."""
    sensor = recorded.world.sensor
    entries = {
        "format": "tofcorr-recording",
        "version": 1,
        "camera": {
            "width": sensor.lens.width,
            "height": sensor.lens.height,
            "K": sensor.lens.matrix,
            "distortion": [float(number) for number in sensor.lens.distortion],
        },
        "depth_kind": sensor.depth_kind,
        "modulation_frequency_hz": sensor.frequencies[-1],
        "saturation_amplitude": None,
        "tool_from_camera": recorded.world.guess.tolist(),
    }
    return "".join(f"{key}: {json.dumps(value)}\n" for key, value in entries.items())


def _frames(recorded: Recorded) -> str:
    world, poses, n = recorded.world, recorded.stated_poses, recorded.world.frames
    normal = world.world_from_target[:3, 2]
    columns: dict[str, Any] = {"frame": np.arange(n), "timestamp_s": world.way.seconds}
    columns |= dict(zip(("tx", "ty", "tz"), poses[:, :3, 3].T, strict=True))
    columns |= dict(zip(("qx", "qy", "qz", "qw"), quaternions(poses[:, :3, :3]).T, strict=True))
    columns |= {k: np.full(n, v) for k, v in zip(("nx", "ny", "nz"), normal, strict=True)}
    columns |= {
        "d": np.full(n, -normal @ world.world_from_target[:3, 3]),
        "target": list(world.surface.kind),
    }
    if not world.design.moving:
        columns["pose_id"] = world.way.pose_id
    optional = {
        "integration_time_us": world.conditions.exposure,
        "body_temperature_c": world.conditions.body,
        "room_temperature_c": world.conditions.room,
        "ambient": world.conditions.ambient,
    }
    columns |= {name: optional[name] for name in world.design.logged}
    rows = zip(*([_cell(value) for value in values] for values in columns.values()), strict=True)
    return "\n".join([",".join(columns), *(",".join(row) for row in rows)]) + "\n"


def _cell(value: object) -> str:
    return f"{value:.9g}" if isinstance(value, np.floating) else str(value)
