"""One frame from pose to measurement, stage by stage, with the hooks of the effects."""

from collections.abc import Sequence

import torch

from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.geometry.rays import plane_in_frame, ray_directions, ray_plane_distance
from tofcorr.simulation.hooks import STAGES, Effect, FrameState, path_phasor
from tofcorr.simulation.options import SensorOptions
from tofcorr.simulation.scene import SceneOptions, seen_reflectivity, target_named, world_from_plane
from tofcorr.simulation.signal import (
    Delays,
    amplitude_per_reflectivity,
    correlation_samples,
    demodulate,
    distance_from_phase,
    harmonic_tensors,
    has_distance,
    read_out,
    signal_phasors,
)


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
        self._rays = ray_directions(camera)
        self._sensor = sensor
        self._scene = scene
        self._effects = tuple(effects)
        self._harmonics = harmonic_tensors(sensor.harmonics)
        self._delays = Delays(sensor.delays, self._rays, sensor.readout.electrons_per_count)

    def run(self, state: FrameState) -> FrameState:
        """Fill `state`, stage by stage.

        Args:
            state: Its fields known from the start, `world_from_tool`, `tool_from_camera`,
                `normal_world` and `offset` are set.

        Returns:
            The same state, measured. A pixel without a distance has NaN.

        Raises:
            ConfigError: The scene does not know the target's name.
        """
        stages = (
            *(self._pose, self._geometry, self._light, self._delay),
            *(self._signal, self._taps, self._readout),
        )
        for name, fill in zip(STAGES, stages, strict=True):
            fill(state)
            for effect in self._effects:
                getattr(effect, f"on_{name}")(state)
        return state

    def _pose(self, state: FrameState) -> None:
        state.ray_directions = self._rays

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
        light, readout = self._sensor.light, self._sensor.readout
        full = amplitude_per_reflectivity(
            light,
            state.radial_distance,
            state.incidence_cosine,
            state.ray_directions,
            state.conditions.integration_time,
        )
        if state.amplitude_recorded is None:
            target = target_named(self._scene.targets, state.target)
            state.reflectivity = seen_reflectivity(target, state.target_xy, self._scene.subsamples)
            state.amplitude = full * state.reflectivity
        else:
            seen = torch.isfinite(state.radial_distance)
            electrons = state.amplitude_recorded * readout.electrons_per_count
            state.amplitude = torch.where(seen, electrons, torch.nan)
            state.reflectivity = state.amplitude / full
        # If background light is unknown, zero is assumed.
        ambient = (state.conditions.ambient or 0.0) * readout.electrons_per_count
        state.background = state.amplitude / light.demodulation_contrast + ambient

    def _delay(self, state: FrameState) -> None:
        state.delay = self._delays.of(state.radial_distance, state.amplitude)

    def _signal(self, state: FrameState) -> None:
        state.orders, relative = self._harmonics
        signal = signal_phasors(
            state.orders,
            relative,
            state.amplitude,
            state.radial_distance + state.delay,
            state.modulation_frequency,
        )
        # Pixels without return are dark. A NaN would spread when an effect blurs the signal.
        state.signal = signal.masked_fill(signal.isnan(), 0.0)

    def _taps(self, state: FrameState) -> None:
        tap_phasor = None
        if state.tap_delay is not None:
            tap_phasor = torch.stack(
                [
                    path_phasor(state.orders, delay, state.modulation_frequency)
                    for delay in state.tap_delay
                ]
            )
        state.taps = correlation_samples(state.orders, state.signal, state.background, tap_phasor)

    def _readout(self, state: FrameState) -> None:
        readout = self._sensor.readout
        state.raw = read_out(state.taps, readout, state.generator)
        phase, amplitude, offset = demodulate(state.raw)
        distance = distance_from_phase(phase, state.modulation_frequency)
        lit = torch.isfinite(state.radial_distance) & (state.amplitude > 0)
        usable = lit & has_distance(
            state.raw, amplitude, readout, noisy=state.generator is not None
        )
        state.measured_distance = torch.where(usable, distance, torch.nan)
        state.measured_amplitude = amplitude
        state.measured_offset = offset
