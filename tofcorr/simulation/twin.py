"""The simulator at the poses, targets and conditions of an existing recording."""

from collections.abc import Iterator, Sequence
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from tofcorr.data.recording import Recording
from tofcorr.geometry import se3
from tofcorr.geometry.rays import radial_distance_from_z_depth, ray_directions
from tofcorr.simulation.effects.backlash import sides_of_approach
from tofcorr.simulation.effects.registry import build_effects
from tofcorr.simulation.hooks import FrameConditions, FrameState
from tofcorr.simulation.options import SimulatorOptions
from tofcorr.simulation.pipeline import SensorPipeline
from tofcorr.simulation.robot import draw_twist, tool_twists

Reflectivity = Literal["pattern", "from_recording"]
"""Source of the brightness of the target: the scene's pattern of that name, or the amplitude of the
recording. In the second case, pixels outside the recording's mask have the recorded distance:
stray light comes from all that the lens sees."""


def twin_frames(
    options: SimulatorOptions,
    recording: Recording,
    generator: torch.Generator | None = None,
    *,
    tool_from_camera: Tensor | None = None,
    reflectivity: Reflectivity = "pattern",
    indices: Sequence[int] | None = None,
) -> Iterator[FrameState]:
    """Simulate the frames of an existing recording.

    Poses, planes, targets, conditions and intrinsics are those of the recording; scene, sensor and
    effects are those of the options. If the recording has no integration time, the reference time
    of the light is used; if it has no background light, zero is used.

    Args:
        options: Scene, sensor, effects, and the robot's repeatability.
        recording: The recording.
        generator: Source of noise; None: the expected measurement at exactly the recorded poses.
        tool_from_camera: Hand-eye transform, shape (4, 4); None: that of the options, or the
            identity if the recording has no robot.
        reflectivity: Source of the brightness of the target.
        indices: Which frames, in this order; None: all.

    Returns:
        An iterator over the states of the frames. `measured_distance`, `measured_amplitude` and
        `raw` are what this camera would report; `radial_distance` is the true distance.

    Raises:
        ConfigError: The scene does not know a target, or an effect is unknown.
        CalibrationDataError: The recording's amplitude is needed, and it has none.
    """
    hand_eye = default_hand_eye(options, recording)
    if tool_from_camera is not None:
        hand_eye = tool_from_camera.to(torch.float64)
    if reflectivity == "from_recording":
        recording.require("amplitude", "a twin that takes the reflectivity from the recording")
    pipeline = SensorPipeline(
        recording.camera, options.sensor, options.scene, build_effects(options.effects)
    )
    rays = ray_directions(recording.camera)
    table = recording.frames
    twists = tool_twists(torch.from_numpy(table.timestamp), torch.from_numpy(table.world_from_tool))
    approach = sides_of_approach(torch.from_numpy(table.world_from_tool))
    reached = _reached_poses(options, recording, generator)

    chosen = range(recording.num_frames) if indices is None else indices

    def initial_state(index: int) -> FrameState:
        row = table.row(index)
        normal = torch.from_numpy(row.normal_world)
        offset = torch.tensor(row.offset, dtype=torch.float64)
        known = reflectivity == "from_recording"
        return FrameState(
            index=index,
            camera=recording.camera,
            modulation_frequency=modulation_frequency(options, recording),
            electrons_per_count=options.sensor.readout.electrons_per_count,
            conditions=FrameConditions(**row.by_name()),
            target=row.target,
            world_from_tool_recorded=torch.from_numpy(row.world_from_tool),
            normal_world_recorded=normal,
            offset_recorded=offset,
            tool_twist=None if twists[index].isnan().any() else twists[index],
            approach=approach[index],
            amplitude_recorded=_image(recording, "amplitude", index) if known else None,
            surroundings=_surroundings(recording, index, rays) if known else None,
            generator=generator,
            world_from_tool=reached[index],
            tool_from_camera=hand_eye,
            normal_world=normal,
            offset=offset,
        )

    return (pipeline.run(initial_state(index)) for index in chosen)


def default_hand_eye(options: SimulatorOptions, recording: Recording) -> Tensor:
    """Return the hand-eye transform of the options; without a robot, the identity."""
    if recording.moves:
        return options.hand_eye.tool_from_camera()
    return torch.eye(4, dtype=torch.float64)


def modulation_frequency(options: SimulatorOptions, recording: Recording) -> float:
    """Return the modulation frequency of the recording in Hz, or that of the options if unknown."""
    return recording.modulation_frequency or options.sensor.modulation_frequency_hz


def _reached_poses(
    options: SimulatorOptions, recording: Recording, generator: torch.Generator | None
) -> Tensor:
    """Return the true poses of the tool, (N, 4, 4): recorded poses with repeatability errors."""
    recorded = torch.from_numpy(recording.frames.world_from_tool)
    if generator is None or not recording.moves:
        return recorded
    robot = options.robot
    scale = (robot.repeatability_mm * 1e-3, robot.repeatability_mrad * 1e-3)
    draws = torch.stack([draw_twist(*scale, generator) for _ in range(recording.num_frames)])
    pose_id = recording.frames.pose_id
    if pose_id is not None:
        # Same pose_id: same pose error; without one, independent errors.
        alone = [f"frame {index}" for index in range(recording.num_frames)]
        stop = np.where(pose_id == "", alone, pose_id)
        _, first, group = np.unique(stop, return_index=True, return_inverse=True)
        draws = draws[torch.from_numpy(first[group])]
    return recorded @ se3.exp(draws)


def _image(recording: Recording, name: str, index: int) -> Tensor | None:
    """Return one frame of an array, shape (H, W), float64; None if the recording has none."""
    frames = recording.read(name, np.array([index]))
    return None if frames is None else torch.from_numpy(frames[0]).double()


def _surroundings(recording: Recording, index: int, rays: Tensor) -> tuple[Tensor, Tensor] | None:
    """Return what was recorded beside the target, as in `FrameState.surroundings`."""
    mask, distance = (_image(recording, name, index) for name in ("mask", "depth"))
    if mask is None or distance is None:
        return None
    if recording.depth_kind == "z":
        distance = radial_distance_from_z_depth(distance, rays)
    returned = distance.isfinite() & (distance > 0)
    return mask == 0, distance.where(returned, torch.nan)
