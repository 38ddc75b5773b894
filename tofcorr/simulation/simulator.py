"""Whole recordings from the simulator."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from tofcorr.conditions import OPTIONAL_CONDITIONS
from tofcorr.data.header import DepthKind
from tofcorr.data.recording import Recording
from tofcorr.data.table import FrameRow
from tofcorr.data.writing import RecordingWriter
from tofcorr.geometry.ranges import z_depth_from_radial_distance
from tofcorr.geometry.rays import ray_directions
from tofcorr.options import resolve_options
from tofcorr.simulation.effects.backlash import sides_of_approach
from tofcorr.simulation.effects.build import build_effects
from tofcorr.simulation.hooks import FrameState
from tofcorr.simulation.options import SimulatorOptions
from tofcorr.simulation.pipeline import SensorPipeline
from tofcorr.simulation.plan import Plan, PlannedFrame, draw_plan

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
