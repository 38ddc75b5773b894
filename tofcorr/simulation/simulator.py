"""Frames from pose to measurement, stage by stage: of a plan, or at those of a recording."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from tofcorr.conditions import CONDITIONS
from tofcorr.data.recording import Recording, pose_numbers
from tofcorr.data.table import FrameRow
from tofcorr.data.writing import RecordingWriter
from tofcorr.errors import ConfigError
from tofcorr.geometry import se3
from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.geometry.rays import (
    plane_in_frame,
    radial_distance_from_z_depth,
    ray_directions,
    ray_plane_distance,
    z_depth_from_radial_distance,
)
from tofcorr.geometry.se3 import tool_twists, world_from_plane
from tofcorr.options import resolve_options
from tofcorr.progress import bar
from tofcorr.simulation.effects.registry import build_effects
from tofcorr.simulation.effects.robot_kinematics import sides_of_approach
from tofcorr.simulation.hooks import STAGES, Effect, FrameFacts, FrameState
from tofcorr.simulation.options import SensorOptions, SimulatorOptions
from tofcorr.simulation.robot import draw_plan, draw_slip, hand_eye_guess
from tofcorr.simulation.scene import SceneOptions, seen_reflectivity, target_named
from tofcorr.simulation.signal import (
    amplitude_per_reflectivity,
    correlation_samples,
    delays,
    demodulate,
    distance_from_phase,
    harmonic_tensors,
    read_out,
)

Reflectivity = Literal["pattern", "from_recording"]
"""Source of the brightness of the target: the scene's pattern of that name, or the amplitude of the
recording. In the second case, pixels outside the recording's mask have the recorded distance:
stray light comes from all that the lens sees."""


class SensorPipeline:
    """A camera in front of a wall: turns the pose of a frame into a measurement.

    Args:
        camera: The camera intrinsics.
        sensor: Light source, pixel and converter.
        scene: Appearance of the targets.
        effects: Effects beyond the plain sensor; at each stage they act in this order.
    """

    def __init__(
        self,
        camera: CameraIntrinsics,
        sensor: SensorOptions,
        scene: SceneOptions,
        effects: Sequence[Effect] = (),
    ) -> None:
        self._camera, self._rays = camera, ray_directions(camera)
        self._sensor, self._scene, self._effects = sensor, scene, tuple(effects)
        self._harmonics = harmonic_tensors(sensor.harmonics)
        self._delay_of = delays(sensor.delays, self._rays, sensor.readout.electrons_per_count)

    def run(self, state: FrameState) -> FrameState:
        """Fill `state`, stage by stage.

        Args:
            state: Its fields known from the start are set.

        Returns:
            The same state, measured. A pixel without a distance has NaN.

        Raises:
            ConfigError: The scene does not know the target's name.
        """
        for name in STAGES:
            getattr(self, f"_{name}")(state)
            for effect in self._effects:
                if hasattr(effect, f"on_{name}"):
                    getattr(effect, f"on_{name}")(state)
        return state

    def _pose(self, state: FrameState) -> None:
        state.camera, state.ray_directions = self._camera, self._rays
        state.modulation_frequency = self._sensor.modulation_frequency_hz
        state.electrons_per_count = self._sensor.readout.electrons_per_count
        state.normal_world, state.offset = state.facts.normal_world[-1], state.facts.offset[-1]

    def _geometry(self, state: FrameState) -> None:
        world_from_camera = state.world_from_camera
        normal, offset = plane_in_frame(state.normal_world, state.offset, world_from_camera)
        rays = state.ray_directions
        state.radial_distance = ray_plane_distance(rays, normal, offset)
        if state.surroundings is not None:
            state.radial_distance = torch.where(*state.surroundings, state.radial_distance)
        state.incidence_cosine = -(rays @ normal)
        points = rays * state.radial_distance[..., None]
        rotation, origin = world_from_camera[:3, :3], world_from_camera[:3, 3]
        state.points_world = points @ rotation.T + origin
        frame = world_from_plane(state.normal_world, state.offset)
        state.target_xy = (state.points_world - frame[:3, 3]) @ frame[:3, :2]

    def _light(self, state: FrameState) -> None:
        light, electrons_per_count = self._sensor.light, state.electrons_per_count
        full = amplitude_per_reflectivity(light, state)
        if state.amplitude_recorded is None:
            target = target_named(self._scene.targets, state.target)
            seen = seen_reflectivity(target, state.target_xy, self._scene.subsamples)
            state.amplitude = full * seen
        else:
            seen = torch.isfinite(state.radial_distance)
            electrons = state.amplitude_recorded * electrons_per_count
            state.amplitude = torch.where(seen, electrons, torch.nan)
        # If background light is unknown, zero is assumed.
        ambient = (state.recorded("ambient") or 0.0) * electrons_per_count
        state.background = state.amplitude / light.demodulation_contrast + ambient

    def _delay(self, state: FrameState) -> None:
        state.delay = self._delay_of(state.radial_distance, state.amplitude)

    def _signal(self, state: FrameState) -> None:
        state.orders, relative = self._harmonics
        turned = state.path_phasor(state.radial_distance + state.delay)
        signal = relative[:, None, None] * state.amplitude * turned
        # Pixels without return are dark. A NaN would spread when an effect blurs the signal.
        state.signal = signal.masked_fill(signal.isnan(), 0.0)

    def _taps(self, state: FrameState) -> None:
        turned = None
        if state.tap_delay is not None:
            turned = torch.stack([state.path_phasor(delay) for delay in state.tap_delay])
        state.taps = correlation_samples(state.orders, state.signal, state.background, turned)

    def _readout(self, state: FrameState) -> None:
        readout = self._sensor.readout
        state.raw = read_out(state.taps, readout, state.generator)
        phase, state.measured_amplitude, _ = demodulate(state.raw)
        distance = distance_from_phase(phase, state.modulation_frequency)
        # Light, an amplitude that is large enough, and no sample saturated.
        lit = torch.isfinite(state.radial_distance) & (state.amplitude > 0)
        counts = state.measured_amplitude
        usable = lit & (counts >= readout.least_amplitude_counts) & (counts > 0)
        if state.generator is not None:
            usable &= (state.raw < readout.largest_count()).all(0)
        state.measured_distance = torch.where(usable, distance, torch.nan)


# Whole recordings: their frames are planned, simulated and written.


def simulate(
    config: str | Path | Mapping[str, Any] | SimulatorOptions,
    out: Path | str,
    generator: torch.Generator | None = None,
    *,
    num_frames: int | None = None,
    noise: bool = True,
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

    Returns:
        The recording, opened.

    Raises:
        ConfigError: There is no such configuration, or it cannot be simulated.
        CalibrationDataError: The recording cannot be written.
    """
    options = resolve_options(SimulatorOptions, config)
    generator = generator or torch.Generator().manual_seed(options.seed)
    seed, mount = generator.initial_seed(), options.hand_eye
    if options.robot_of is None:
        plan = draw_plan(options, generator, num_frames=num_frames)
    else:
        plan = plan_beside(options, Recording.open(options.robot_of))[:num_frames]
    guess = hand_eye_guess(mount, generator)
    writer = RecordingWriter(
        out,
        camera=options.camera.intrinsics(),
        depth_kind=options.depth_kind,
        modulation_frequency=options.sensor.modulation_frequency_hz,
        tool_from_camera=guess.numpy(),
        frame_names=options.frames,
    )
    with writer, bar(len(plan), "simulating") as advance:
        for state in take_frames(options, plan, generator if noise else None):
            append_frame(writer, state, options)
            advance(1)
        truth = {"tool_from_camera": mount.tool_from_camera().tolist(), "seed": seed}
        writer.add_truth("truth", truth)
        writer.add_truth("options", options.to_mapping())
    # The writer has checked each frame already.
    return Recording.open(out, check_contents=False)


def take_frames(
    options: SimulatorOptions, plan: Iterable[FrameState], generator: torch.Generator | None
) -> Iterator[FrameState]:
    """Simulate the frames of a plan.

    Args:
        options: Camera, scene, robot.
        plan: The frames, of `draw_plan`.
        generator: Source of noise; None: the expected measurement at the recorded poses.

    Raises:
        ConfigError: An effect or a target is unknown.
    """
    camera, effects = options.camera.intrinsics(), build_effects(options.effects)
    pipeline = SensorPipeline(camera, options.sensor, options.scene, effects)
    for planned in plan:
        reached = planned.world_from_tool
        if generator is None:
            reached = planned.facts.world_from_tool[-1]
        yield pipeline.run(replace(planned, generator=generator, world_from_tool=reached))


def append_frame(writer: RecordingWriter, state: FrameState, options: SimulatorOptions) -> None:
    """Append what the camera measured and recorded, and its true distance and pose to `truth/`."""
    recorded, facts, depth = options.conditions.recorded, state.facts, state.measured_distance
    if options.depth_kind == "z":
        depth = z_depth_from_radial_distance(depth, ray_directions(state.camera))
    names = [name for name in CONDITIONS if name in (*recorded, "timestamp")]
    known: dict[str, Any] = {name: state.recorded(name) for name in names}
    row = FrameRow(
        **known,
        world_from_tool=facts.world_from_tool[-1].numpy(),
        normal_world=facts.normal_world[-1].numpy(),
        offset=float(facts.offset[-1]),
        target=state.target,
        pose_id=state.pose_id if "pose_id" in recorded else None,
        joint_angles=None if facts.joint_angles is None else facts.joint_angles[-1].numpy(),
    )
    writer.append(
        depth.numpy(),
        row=row,
        amplitude=state.measured_amplitude.nan_to_num(0.0).numpy(),
        raw=state.raw.numpy() if options.write_raw else None,
        truth={
            "radial_distance": state.radial_distance.numpy().astype(np.float32),
            "world_from_tool": state.world_from_tool.numpy(),
        },
    )


# The simulator at the poses, targets and conditions of an existing recording.


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
    if tool_from_camera is None:
        tool_from_camera = default_hand_eye(options, recording)
    known = reflectivity == "from_recording"
    if known:
        recording.require("amplitude", "a twin that takes the reflectivity from the recording")
    own = options.sensor.modulation_frequency_hz
    frequency = {"modulation_frequency_hz": recording.modulation_frequency or own}
    sensor, effects = options.sensor.model_copy(update=frequency), build_effects(options.effects)
    pipeline = SensorPipeline(recording.camera, sensor, options.scene, effects)
    chosen = list(range(recording.num_frames)) if indices is None else list(indices)
    facts = facts_of(recording).at(chosen)
    reached = _reached_poses(options, recording, generator)

    def simulated(place: int) -> FrameState:
        index = chosen[place]
        state = FrameState(
            index=index,
            facts=facts.at(slice(place + 1)),
            target=str(recording.frames.target[index]),
            world_from_tool=reached[index],
            tool_from_camera=tool_from_camera.to(torch.float64),
            generator=generator,
            amplitude_recorded=_image(recording, "amplitude", index) if known else None,
            surroundings=_surroundings(recording, index) if known else None,
        )
        return pipeline.run(state)

    return map(simulated, range(len(chosen)))


def facts_of(recording: Recording) -> FrameFacts:
    """Return what a recording says of its frames; the tool's velocity follows from its poses."""
    table = recording.frames
    poses, known = torch.from_numpy(table.world_from_tool), table.by_name()
    conditions: dict[str, Any] = {
        name: None if values is None else torch.from_numpy(np.asarray(values, dtype=np.float64))
        for name, values in known.items()
    }
    return FrameFacts(
        world_from_tool=poses,
        normal_world=torch.from_numpy(table.normal_world),
        offset=torch.from_numpy(table.offset),
        tool_twist=tool_twists(conditions["timestamp"], poses) if recording.moves else None,
        approach=sides_of_approach(poses),
        joint_angles=None if table.joint_angles is None else torch.from_numpy(table.joint_angles),
        **conditions,
    )


def plan_beside(options: SimulatorOptions, recording: Recording) -> list[FrameState]:
    """Return the frames of another camera that a simulated recording's robot carries.

    Args:
        options: Of the other camera: its hand-eye transform.
        recording: The simulated recording.

    Raises:
        ConfigError: It holds no true poses.
    """
    file = recording.path / "truth" / "world_from_tool.npy"
    if not file.is_file():
        raise ConfigError(f"robot_of: expected a simulated recording, with {file}.")
    facts, reached = facts_of(recording), torch.from_numpy(np.load(file))
    stops = pose_numbers(recording).tolist()
    return [
        FrameState(
            index=index,
            facts=facts.at(slice(index + 1)),
            target=str(recording.frames.target[index]),
            world_from_tool=reached[index],
            tool_from_camera=options.hand_eye.tool_from_camera(),
            pose_id=stop,
        )
        for index, stop in enumerate(stops)
    ]


def default_hand_eye(options: SimulatorOptions, recording: Recording) -> Tensor:
    """Return the hand-eye transform of the options; without a robot, the identity."""
    if recording.moves:
        return options.hand_eye.tool_from_camera()
    return torch.eye(4, dtype=torch.float64)


def _reached_poses(
    options: SimulatorOptions, recording: Recording, generator: torch.Generator | None
) -> Tensor:
    """Return the true poses of the tool, (N, 4, 4): recorded poses with repeatability errors."""
    recorded = torch.from_numpy(recording.frames.world_from_tool)
    if generator is None or not recording.moves:
        return recorded
    # Frames that were taken without moving share one error.
    pose = pose_numbers(recording)
    slips = torch.stack([draw_slip(options.robot, generator) for _ in np.unique(pose)])
    return recorded @ se3.exp(slips[torch.from_numpy(pose)])


def _image(recording: Recording, name: str, index: int) -> Tensor | None:
    """Return one frame of an array, shape (H, W), float64; None if the recording has none."""
    frames = recording.read(name, np.array([index]))
    return None if frames is None else torch.from_numpy(frames[0]).double()


def _surroundings(recording: Recording, index: int) -> tuple[Tensor, Tensor] | None:
    """Return what was recorded beside the target, as in `FrameState.surroundings`."""
    mask, distance = (_image(recording, name, index) for name in ("mask", "depth"))
    if mask is None or distance is None:
        return None
    if recording.depth_kind == "z":
        distance = radial_distance_from_z_depth(distance, ray_directions(recording.camera))
    returned = distance.isfinite() & (distance > 0)
    return mask == 0, distance.where(returned, torch.nan)
