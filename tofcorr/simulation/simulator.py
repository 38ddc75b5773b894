"""Whole recordings from the simulator: the frames are planned, simulated, and written."""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tofcorr.conditions import OPTIONAL_CONDITIONS
from tofcorr.data.recording import DepthKind, Recording
from tofcorr.data.table import FrameRow
from tofcorr.data.writing import RecordingWriter
from tofcorr.errors import ConfigError
from tofcorr.geometry import se3
from tofcorr.geometry.rays import (
    plane_in_frame,
    ray_directions,
    ray_plane_distance,
    z_depth_from_radial_distance,
)
from tofcorr.options import resolve_options
from tofcorr.simulation.effects.backlash import sides_of_approach
from tofcorr.simulation.effects.registry import build_effects
from tofcorr.simulation.hooks import FrameConditions, FrameState
from tofcorr.simulation.options import SimulatorOptions
from tofcorr.simulation.pipeline import SensorPipeline
from tofcorr.simulation.robot import (
    FillsImage,
    draw_camera_path,
    draw_camera_poses,
    draw_conditions,
    draw_timestamps,
    draw_twist,
    perturbed,
)
from tofcorr.simulation.scene import world_from_plane


@dataclass(frozen=True, kw_only=True)
class PlannedFrame:
    """One frame before it is simulated.

    Attributes:
        target: Name of the target.
        pose_id: Frames with the same id are taken without moving; None if the robot never stops.
        conditions: All conditions, recorded or not.
        world_from_tool_recorded: What the robot reports, shape (4, 4).
        world_from_tool: The true pose, shape (4, 4).
        tool_twist: Velocity in the tool's own frame, translation first, shape (6,), m/s and rad/s.
    """

    target: str
    pose_id: int | None
    conditions: FrameConditions
    world_from_tool_recorded: Tensor
    world_from_tool: Tensor
    tool_twist: Tensor


@dataclass(frozen=True, kw_only=True)
class Plan:
    """All frames of a recording before they are simulated, and its hand-eye guess (4, 4)."""

    frames: tuple[PlannedFrame, ...]
    tool_from_camera_guess: Tensor


def draw_plan(
    options: SimulatorOptions, generator: torch.Generator, *, num_frames: int | None = None
) -> Plan:
    """Draw poses, targets and conditions of a recording.

    Args:
        options: Camera, scene, robot.
        generator: Source of randomness.
        num_frames: Only the first frames; None: all.

    Raises:
        ConfigError: No pose was found where the wall fills the image, or fewer frames are
            planned than asked for.
    """
    targets = [shot.target for shot in options.shots for _ in range(shot.poses)]
    order = torch.randperm(len(targets), generator=generator).tolist()
    targets = [targets[place] for place in order]
    plan = _plan_path if options.robot.motion == "continuous" else _plan_stops
    frames = plan(options, targets, generator)
    if num_frames is not None and num_frames > len(frames):
        raise ConfigError(
            f"{num_frames} frames are asked for, but the options plan {len(frames)}; "
            "raise 'poses' under 'shots'."
        )
    frames = frames[:num_frames]
    guess = torch.eye(4, dtype=torch.float64)
    if options.hand_eye.guess is not None:
        truth = options.hand_eye.tool_from_camera()
        guess = perturbed(truth, options.hand_eye.guess, generator)
    return Plan(frames=tuple(frames), tool_from_camera_guess=guess)


def _plan_stops(
    options: SimulatorOptions, targets: list[str], generator: torch.Generator
) -> list[PlannedFrame]:
    robot = options.robot
    poses = draw_camera_poses(robot, len(targets), _fills_image(options), generator)
    if robot.order == "by_distance":
        poses.sort(key=lambda pose: pose.distance)
    repeats = [
        robot.repeat_frames if pose < robot.repeat_poses else 1 for pose in range(len(poses))
    ]
    pose_ids = [pose for pose, count in enumerate(repeats) for _ in range(count)]
    jitter = options.conditions.interval_jitter
    timestamps = draw_timestamps(options.conditions, len(pose_ids), jitter, generator)
    conditions = draw_conditions(options.conditions, timestamps, pose_ids, generator)
    commanded = [_world_from_tool(options, pose.plane_from_camera) for pose in poses]
    reached = [pose @ _robot_noise(options, generator) for pose in commanded]
    at_rest = torch.zeros(6, dtype=torch.float64)
    return [
        PlannedFrame(
            target=targets[pose],
            pose_id=pose,
            conditions=frame_conditions,
            world_from_tool_recorded=commanded[pose],
            world_from_tool=reached[pose],
            tool_twist=at_rest,
        )
        for pose, frame_conditions in zip(pose_ids, conditions, strict=True)
    ]


def _plan_path(
    options: SimulatorOptions, targets: list[str], generator: torch.Generator
) -> list[PlannedFrame]:
    timestamps = draw_timestamps(options.conditions, len(targets), 0.0, generator)
    poses, camera_twists = draw_camera_path(
        options.robot, timestamps, _fills_image(options), generator
    )
    frames = list(range(len(targets)))
    conditions = draw_conditions(options.conditions, timestamps, frames, generator)
    tool_from_camera = options.hand_eye.tool_from_camera()
    planned = []
    for frame, frame_conditions in zip(frames, conditions, strict=True):
        commanded = _world_from_tool(options, poses[frame].plane_from_camera)
        planned.append(
            PlannedFrame(
                target=targets[frame],
                pose_id=None,
                conditions=frame_conditions,
                world_from_tool_recorded=commanded,
                world_from_tool=commanded @ _robot_noise(options, generator),
                tool_twist=_adjoint(tool_from_camera) @ camera_twists[frame],
            )
        )
    return planned


def _world_from_tool(options: SimulatorOptions, plane_from_camera: Tensor) -> Tensor:
    world_from_camera = world_from_plane(*options.scene.plane.tensors()) @ plane_from_camera
    return world_from_camera @ se3.inverse(options.hand_eye.tool_from_camera())


def _robot_noise(options: SimulatorOptions, generator: torch.Generator) -> Tensor:
    robot = options.robot
    return se3.exp(
        draw_twist(robot.repeatability_mm * 1e-3, robot.repeatability_mrad * 1e-3, generator)
    )


def _adjoint(transform: Tensor) -> Tensor:
    """Return the (6, 6) matrix that carries a twist, translation first, to the target frame."""
    rotation, (x, y, z) = transform[:3, :3], transform[:3, 3].tolist()
    cross = transform.new_tensor([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    top = torch.cat([rotation, cross @ rotation], dim=1)
    return torch.cat([top, torch.cat([torch.zeros_like(rotation), rotation], dim=1)])


def _fills_image(options: SimulatorOptions) -> FillsImage:
    """Return a function that says whether every pixel sees the wall, near and frontal enough."""
    rays = ray_directions(options.camera.intrinsics())
    # The wall is flat: if the rays at the image border satisfy the limits, so do all others.
    border = torch.cat(
        [rays[:1], rays[-1:], rays[:, :1].transpose(0, 1), rays[:, -1:].transpose(0, 1)], 1
    )
    steepest = math.cos(math.radians(options.robot.steepest_incidence_deg))
    farthest = options.robot.farthest_pixel_m or math.inf
    wall = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)

    def fills_image(plane_from_camera: Tensor) -> bool:
        normal, offset = plane_in_frame(wall, wall.new_zeros(()), plane_from_camera)
        distance = ray_plane_distance(border, normal, offset)
        frontal = -(border @ normal) >= steepest
        return bool((frontal & (distance <= farthest)).all())

    return fills_image


# Simulation and recording of the planned frames.


Progress = Callable[[Iterator[FrameState], int], Iterable[FrameState]]
"""Wraps an iterator over frames, given their number, as `tqdm(frames, total=...)` does."""


def simulate(
    config: str | Path | Mapping[str, Any] | SimulatorOptions,
    out: Path | str,
    generator: torch.Generator | None = None,
    *,
    num_frames: int | None = None,
    noise: bool = True,
    progress: Progress | None = None,
) -> Recording:
    """Simulate a camera on a robot before a wall, and write what it records.

    `truth/` holds `radial_distance.npy` (float32, per frame and pixel, metres),
    `world_from_tool.npy` (the true poses), `truth.yaml` (the hand-eye transform and the seed)
    and `options.yaml`.

    Args:
        config: Camera, scene, robot: the name of a shipped configuration (`"demo"`), a file, keys
            and values, or options.
        out: The folder to write; it must not exist yet.
        generator: Source of randomness; None: from the seed of the configuration.
        num_frames: Simulate only this many frames; None: all.
        noise: False: the expected measurement at exactly the recorded poses.
        progress: Shows how many frames are done.

    Returns:
        The recording, opened.

    Raises:
        ConfigError: There is no such configuration, or it cannot be simulated.
        CalibrationDataError: The recording cannot be written.
    """
    options = resolve_options(SimulatorOptions, config)
    generator = seeded(options) if generator is None else generator
    truth = _truth(options, generator)
    plan = draw_plan(options, generator, num_frames=num_frames)
    rows = [_row(options, frame) for frame in plan.frames]
    states = take_frames(options, plan, generator if noise else None)
    with RecordingWriter(
        out,
        camera=options.camera.intrinsics(),
        depth_kind=options.depth_kind,
        modulation_frequency=options.sensor.modulation_frequency_hz,
        tool_from_camera=plan.tool_from_camera_guess.numpy(),
    ) as writer:
        shown = states if progress is None else progress(states, len(rows))
        for state, row in zip(shown, rows, strict=True):
            append_measurement(writer, state, options.depth_kind, options.write_raw, row)
        add_truth(writer, truth, options)
    # The writer has checked each frame already.
    return Recording.open(out, check_contents=False)


def take_frames(
    options: SimulatorOptions, plan: Plan, generator: torch.Generator | None
) -> Iterator[FrameState]:
    """Simulate the frames of a plan.

    Args:
        options: Camera, scene, robot.
        plan: The frames.
        generator: Source of noise; None: the expected measurement at the recorded poses.

    Raises:
        ConfigError: An effect or a target is unknown.
    """
    pipeline = SensorPipeline(
        options.camera.intrinsics(), options.sensor, options.scene, build_effects(options.effects)
    )
    poses = [frame.world_from_tool_recorded for frame in plan.frames]
    approach = sides_of_approach(torch.stack(poses))
    return (
        pipeline.run(_initial_state(options, frame, index, generator, approach[index]))
        for index, frame in enumerate(plan.frames)
    )


def _initial_state(
    options: SimulatorOptions,
    frame: PlannedFrame,
    index: int,
    generator: torch.Generator | None,
    approach: torch.Tensor,
) -> FrameState:
    normal, offset = options.scene.plane.tensors()
    reached = frame.world_from_tool_recorded if generator is None else frame.world_from_tool
    return FrameState(
        index=index,
        camera=options.camera.intrinsics(),
        modulation_frequency=options.sensor.modulation_frequency_hz,
        electrons_per_count=options.sensor.readout.electrons_per_count,
        conditions=frame.conditions,
        target=frame.target,
        world_from_tool_recorded=frame.world_from_tool_recorded,
        normal_world_recorded=normal,
        offset_recorded=offset,
        tool_twist=frame.tool_twist,
        approach=approach,
        generator=generator,
        world_from_tool=reached,
        tool_from_camera=options.hand_eye.tool_from_camera(),
        normal_world=normal,
        offset=offset,
    )


def seeded(options: SimulatorOptions) -> torch.Generator:
    """Return a generator that starts from the options' seed."""
    return torch.Generator().manual_seed(options.seed)


def append_measurement(
    writer: RecordingWriter,
    state: FrameState,
    depth_kind: DepthKind,
    write_raw: bool,
    row: FrameRow | None,
    mask: np.ndarray | None = None,
) -> None:
    """Append the measurement of the camera, and its true distance and pose to `truth/`."""
    depth = state.measured_distance
    if depth_kind == "z":
        depth = z_depth_from_radial_distance(depth, ray_directions(state.camera))
    writer.append(
        depth.numpy(),
        row=row,
        amplitude=state.measured_amplitude.nan_to_num(0.0).numpy(),
        mask=mask,
        raw=state.raw.numpy() if write_raw else None,
        truth={
            "radial_distance": state.radial_distance.numpy().astype(np.float32),
            "world_from_tool": state.world_from_tool.numpy(),
        },
    )


def add_truth(writer: RecordingWriter, truth: dict[str, Any], options: SimulatorOptions) -> None:
    """Add the true values and the options to `truth/`."""
    writer.add_truth("truth", truth)
    writer.add_truth("options", options.to_mapping())


def _truth(options: SimulatorOptions, generator: torch.Generator) -> dict[str, Any]:
    return {
        "tool_from_camera": options.hand_eye.tool_from_camera().tolist(),
        "seed": generator.initial_seed(),
    }


def _row(options: SimulatorOptions, frame: PlannedFrame) -> FrameRow:
    recorded = options.conditions.recorded
    normal, offset = options.scene.plane.tensors()
    known = {
        each.name: getattr(frame.conditions, each.name)
        for each in OPTIONAL_CONDITIONS
        if each.name in recorded
    }
    return FrameRow(
        timestamp=frame.conditions.timestamp,
        world_from_tool=frame.world_from_tool_recorded.numpy(),
        normal_world=normal.numpy(),
        offset=float(offset),
        target=frame.target,
        pose_id=frame.pose_id if "pose_id" in recorded else None,
        **known,
    )
