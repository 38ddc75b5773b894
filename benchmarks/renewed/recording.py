"""One recording with what is true of it; recording folders, version 1, written and read.

NumPy and plain text alone: nothing of the program under test takes part.
"""

import csv
import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from benchmarks.renewed.geometry import Array, Camera, Random, small_motions, transforms
from benchmarks.renewed.signal_chain import Hook, Measured, field_of, mask_of, measure
from benchmarks.renewed.world import World

WEAKEST = 3.0  # times its noise: a weaker amplitude is no return

LEAST_NEAR_PIXELS = 6  # on the target in a frame; with fewer the frame has an empty mask


@dataclass(frozen=True)
class Recorded:
    """What camera and robot give."""

    world: World
    stated_poses: Array  # world_from_tool (N, 4, 4)
    depth: Array  # (N, H, W) of the kind that the camera gives, NaN where nothing returned
    amplitude: Array  # counts
    mask: np.ndarray
    stated_target: Array | None = None  # world_from_target of each frame; None: that of the world


@dataclass(frozen=True)
class Truth:
    """What is withheld, metres: each effect's error, and the radial distance without noise."""

    fields: Mapping[str, Array]
    expected: Array

    def sizes_mm(self, recorded: Recorded) -> dict[str, float]:
        """RMS of each field over the pixels used."""
        used = recorded.mask & np.isfinite(recorded.depth)
        sizes = {k: np.sqrt(np.mean(field[used] ** 2)) for k, field in self.fields.items()}
        return {name: 1e3 * float(size) for name, size in sizes.items()}


def record(rng: Random, world: World, hooks: Sequence[Hook]) -> tuple[Recorded, Truth]:
    """Record a world with effects."""
    clean, expected = measure(world), measure(world, hooks)
    seen = measure(world, hooks, rng)
    fields = {hook.form.effect: field_of(measure(world, [hook]), clean) for hook in hooks}
    depth = seen.depth
    if world.sensor.rounding:
        depth = np.round(depth / world.sensor.rounding) * world.sensor.rounding
    depth = np.where(_returned(seen), depth, np.nan)
    design = world.design
    mask = mask_of(rng, seen, depth, design.mask, design.ransac)
    if not design.mask.startswith("RANSAC"):
        mask = mask & clean.view.on_target
    mask &= mask.sum(axis=(1, 2), keepdims=True) >= LEAST_NEAR_PIXELS
    recorded = Recorded(
        world=world,
        stated_poses=world.world_from_tool() @ pose_noise(rng, world),
        depth=depth * depth_over_range(world),
        amplitude=seen.amplitude * world.sensor.lens.counts_per_electron,
        mask=mask,
    )
    return recorded, Truth(fields, expected.depth)


def pose_noise(rng: Random, world: World) -> Array:
    """Transforms (N, 4, 4) from the tool as the robot states it to where it is; one a pose."""
    slip, shape = world.design.robot, (world.way.poses, 3)
    noise = small_motions(slip * rng.standard_normal(shape), slip * rng.standard_normal(shape))
    return noise[world.way.pose_id]


def depth_over_range(world: World) -> Array:
    """What the recording's depth is of the radial distance (H, W)."""
    rays = world.sensor.lens.rays()
    return rays[..., 2] if world.sensor.depth_kind == "z" else np.ones(rays.shape[:2])


def _returned(seen: Measured) -> np.ndarray:
    dark = 30.0**2 + seen.view.world.sensor.sun * 0.5  # electrons of read noise and sunlight
    noise = np.sqrt(seen.view.amplitude + dark) / np.sqrt(2)
    return (seen.amplitude > WEAKEST * noise) & (seen.depth > 0)


def write_recording(folder: Path, recorded: Recorded, without: Collection[str] = ()) -> None:
    """Write a recording.

    Args:
        folder: Where; nothing may be there.
        recorded: What to write.
        without: Columns, files and entries of the header that are left out.
    """
    folder.mkdir(parents=True)
    images = {"depth": np.float32, "mask": np.uint8, "amplitude": np.float32}
    for name, kind in images.items():
        if f"{name}.npy" not in without:
            np.save(folder / f"{name}.npy", getattr(recorded, name).astype(kind))
    (folder / "frames.csv").write_text(_frames(recorded, without))
    sensor = recorded.world.sensor
    entries: dict[str, Any] = {
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
    # YAML's flow style, which is JSON.
    lines = [f"{k}: {json.dumps(v)}\n" for k, v in entries.items() if k not in without]
    (folder / "recording.yaml").write_text("".join(lines))


def _frames(recorded: Recorded, without: Collection[str]) -> str:
    world, poses, n = recorded.world, recorded.stated_poses, recorded.world.frames
    target = world.world_from_target if recorded.stated_target is None else recorded.stated_target
    target = np.broadcast_to(target, (n, 4, 4))
    columns: dict[str, Any] = {"frame": np.arange(n), "timestamp_s": world.way.seconds}
    columns |= dict(zip(("tx", "ty", "tz"), poses[:, :3, 3].T, strict=True))
    quaternion = Rotation.from_matrix(poses[:, :3, :3]).as_quat(canonical=True)
    columns |= dict(zip(("qx", "qy", "qz", "qw"), quaternion.T, strict=True))
    columns |= dict(zip(("nx", "ny", "nz"), target[:, :3, 2].T, strict=True))
    columns["d"] = -(target[:, :3, 2] * target[:, :3, 3]).sum(-1)
    columns["target"] = list(world.surface.kind)
    if not world.design.moving:
        columns["pose_id"] = world.way.pose_id
    optional = {
        "integration_time_us": world.conditions.exposure,
        "body_temperature_c": world.conditions.body,
        "room_temperature_c": world.conditions.room,
        "ambient": world.conditions.ambient,
    }
    columns |= {name: optional[name] for name in world.design.logged}
    columns = {name: values for name, values in columns.items() if name not in without}
    rows = zip(*([_cell(value) for value in values] for values in columns.values()), strict=True)
    return "\n".join([",".join(columns), *(",".join(row) for row in rows)]) + "\n"


def _cell(value: object) -> str:
    return f"{value:.9g}" if isinstance(value, np.floating) else str(value)


@dataclass(frozen=True)
class Data:
    """A recording as the benchmarks read it; arrays of frames have N rows."""

    rays: Array  # (H, W, 3)
    depth: Array  # (N, H, W) radial, metres
    depth_per_range: Array  # (H, W): the recording's depth over the radial distance
    amplitude: Array | None
    valid: np.ndarray  # (N, H, W)
    world_from_tool: Array  # (N, 4, 4)
    normal: Array  # (N, 3)
    offset: Array  # (N,)
    tool_from_camera: Array  # (4, 4), the guess
    columns: dict[str, Array]  # numeric columns of frames.csv that are there

    @property
    def moves(self) -> bool:
        """Whether there is a robot, and so a hand-eye transform to estimate."""
        return bool(np.abs(self.world_from_tool - np.eye(4)).max() > 1e-12)


def read(folder: Path) -> Data:
    """Read a recording folder."""
    about = yaml.safe_load((folder / "recording.yaml").read_text())
    with (folder / "frames.csv").open() as file:
        rows = list(csv.DictReader(file))
    columns = {k: np.array([float(row[k]) for row in rows]) for k in rows[0] if k != "target"}
    depth, stored = np.load(folder / "depth.npy").astype(float), folder / "amplitude.npy"
    k = about["camera"].pop("K")
    focal, centre = (k[0][0], k[1][1]), (k[0][2], k[1][2])
    units: dict[str, Any] = {"sensitivity": 1.0, "counts_per_electron": 1.0}
    rays = Camera(**about["camera"], focal=focal, centre=centre, **units).rays()
    per_range = rays[..., 2] if about["depth_kind"] == "z" else np.ones(rays.shape[:2])
    quaternion = np.stack([columns[name] for name in ("qx", "qy", "qz", "qw")], -1)
    rotation = Rotation.from_quat(quaternion).as_matrix()
    amplitude = np.load(stored).astype(float) if stored.exists() else None
    limit = about["saturation_amplitude"]
    lit = amplitude < limit if amplitude is not None and limit is not None else True
    place, normal = (np.stack([columns[a + b] for b in "xyz"], -1) for a in "tn")
    return Data(
        rays=rays,
        depth=depth / per_range,
        depth_per_range=per_range,
        amplitude=amplitude,
        valid=(np.load(folder / "mask.npy") > 0) & np.isfinite(depth) & (depth > 0) & lit,
        world_from_tool=transforms(rotation, place),
        normal=normal,
        offset=columns["d"],
        tool_from_camera=np.array(about["tool_from_camera"]),
        columns=columns,
    )
