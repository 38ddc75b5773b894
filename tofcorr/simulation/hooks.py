"""The stages of a simulated frame, where effects act, and the state that passes through them.

A frame passes through seven stages in this order. Before an effect is called at a stage, the
simulator has filled the fields of that stage and of all earlier ones. Later stages use what the
effect has written.

    on_pose      true poses of camera and target: world_from_tool, tool_from_camera,
                 normal_world, offset, ray_directions. Distances are not computed yet.
    on_geometry  radial_distance, incidence_cosine, points_world, target_xy.
    on_light     amplitude, background: electrons of modulated and of constant light.
    on_delay     delay: extra optical distance in metres.
    on_signal    signal: the phasor of every harmonic in every pixel; tap_delay.
    on_taps      taps: expected electrons of A0..A3, before noise and quantisation.
    on_readout   measured_distance, measured_amplitude: what the camera reports.

Everything is float64 (`signal` is complex128). Without noise the measured distance is
differentiable in every field, if effects assign new tensors and never write into existing ones.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Self

import torch
from torch import Tensor

from tofcorr.conditions import Conditions
from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.geometry.rays import phase_from_radial_distance, plane_in_frame

STAGES = ("pose", "geometry", "light", "delay", "signal", "taps", "readout")
"""The stages in order; an effect may define `on_<stage>(state)` for any of them."""

_NOT_YET = torch.empty(0, dtype=torch.float64)


@dataclass(frozen=True, kw_only=True, eq=False)
class FrameFacts(Conditions[Tensor]):
    """What is recorded of F frames; None or NaN is unknown, never zero.

    The conditions are those of `Conditions`, each of shape (F,), float64.

    Attributes:
        world_from_tool: Poses that the robot reports, shape (F, 4, 4).
        normal_world: Unit normals of the target, shape (F, 3).
        offset: d of n . x + d = 0, shape (F,), metres.
        tool_twist: Velocity of the tool in its own frame, translation first, shape (F, 6), m/s and
            rad/s: world_from_tool(t + dt) = world_from_tool(t) exp(twist dt).
        approach: From which side the tool came: see `sides_of_approach`, shape (F, 3).
        joint_angles: Of the robot's joints, shape (F, J), radians or metres.
    """

    world_from_tool: Tensor
    normal_world: Tensor
    offset: Tensor
    tool_twist: Tensor | None = None
    approach: Tensor | None = None
    joint_angles: Tensor | None = None

    def at(self, frames: slice | Sequence[int]) -> Self:
        """Return the facts of some of the frames."""
        known = vars(self).items()
        chosen: dict[str, Any] = {k: None if v is None else v[frames] for k, v in known}
        return type(self)(**chosen)

    def planes_seen(self, tool_from_camera: Tensor) -> tuple[Tensor, Tensor]:
        """Return normal (F, 3) and offset (F,) of each frame's plane in the camera's frame."""
        pose = self.world_from_tool @ tool_from_camera
        return plane_in_frame(self.normal_world, self.offset, pose)


@dataclass(kw_only=True)
class FrameState:
    """One frame between pose and measurement; mutable, one object per frame.

    Known from the start:
        index: Number of the frame; frames come in the order of the recording.
        facts: What is recorded of this frame, the last one, and of those simulated before it;
            `ambient` is in counts per tap, as the amplitude.
        target: Name of the target.
        world_from_tool: True pose of the tool, shape (4, 4).
        tool_from_camera: True hand-eye transform, shape (4, 4).
        pose_id: Frames with the same id are taken without moving; None if the robot never stops.
        generator: Source of randomness; None: the expected measurement, nothing is drawn.
        amplitude_recorded: Counts, shape (H, W), if the brightness of the target is taken from a
            recording; None: from the target's pattern.
        surroundings: Which pixels do not see the target, shape (H, W), bool, and the distances
            along their rays, shape (H, W), metres (NaN: no return). None: the target fills the
            image.

    Stage pose:
        camera: Intrinsics as recorded (the true rays may differ).
        modulation_frequency: Hz, as recorded (the true one may differ).
        electrons_per_count: Electrons for one count of amplitude, offset or raw sample.
        ray_directions: True unit viewing rays in the camera frame, shape (H, W, 3).
        normal_world: True unit normal of the target, on the camera's side, shape (3,).
        offset: True d in n . x + d = 0, shape (), metres.

    Stage geometry:
        radial_distance: True distances along the rays, shape (H, W), metres; NaN where none.
        incidence_cosine: Cosine of the angle between ray and normal, shape (H, W), in (0, 1].
        points_world: Where the rays meet the target, shape (H, W, 3), metres.
        target_xy: The same points in the coordinates of the target, shape (H, W, 2), metres.

    Stage light:
        amplitude: Modulated light in electrons per tap, shape (H, W): taps swing by +- amplitude.
        background: Mean of the taps in electrons, shape (H, W): constant part of the camera's light
            plus ambient light.

    Stage delay:
        delay: Extra optical distance, shape (H, W), metres. Positive: the camera reads too far.

    Stage signal:
        orders: Orders m of the harmonics, shape (M,), the first one 1.
        signal: Phasors, shape (M, H, W): tap k receives
            background + Re sum_m signal[m] exp(1j m k pi / 2). Light that comes by a path longer
            by L turns order m by m 4 pi f L / c (`path_phasor`).
        tap_delay: Extra optical distance of each tap alone, shape (4, H, W), metres, or None.

    Stage taps:
        taps: Expected electrons of A0..A3, shape (4, H, W).

    Stage readout:
        measured_distance: Radial distance as reported, shape (H, W), metres.
        measured_amplitude: Counts, shape (H, W).
        raw: The four samples as read out, counts, shape (4, H, W).
    """

    index: int
    facts: FrameFacts
    target: str
    world_from_tool: Tensor
    tool_from_camera: Tensor
    pose_id: int | None = None
    generator: torch.Generator | None = None
    amplitude_recorded: Tensor | None = None
    surroundings: tuple[Tensor, Tensor] | None = None

    camera: CameraIntrinsics = field(init=False)
    modulation_frequency: float = field(init=False)
    electrons_per_count: float = field(init=False)
    ray_directions: Tensor = _NOT_YET
    normal_world: Tensor = _NOT_YET
    offset: Tensor = _NOT_YET

    radial_distance: Tensor = _NOT_YET
    incidence_cosine: Tensor = _NOT_YET
    points_world: Tensor = _NOT_YET
    target_xy: Tensor = _NOT_YET

    amplitude: Tensor = _NOT_YET
    background: Tensor = _NOT_YET

    delay: Tensor = _NOT_YET

    orders: Tensor = _NOT_YET
    signal: Tensor = _NOT_YET
    tap_delay: Tensor | None = None

    taps: Tensor = _NOT_YET

    measured_distance: Tensor = _NOT_YET
    measured_amplitude: Tensor = _NOT_YET
    raw: Tensor = _NOT_YET

    def recorded(self, name: str) -> float | None:
        """Return what is recorded of a condition of the frame; None: it is unknown."""
        values = getattr(self.facts, name)
        return None if values is None or values[-1].isnan() else float(values[-1])

    @property
    def world_from_camera(self) -> Tensor:
        """True pose of the camera, shape (4, 4)."""
        return self.world_from_tool @ self.tool_from_camera

    def path_phasor(self, extra_distance: Tensor | float) -> Tensor:
        """Return the factor that an extra radial distance puts on every harmonic.

        Args:
            extra_distance: Half of the extra path of the light, metres, shape () or (H, W).

        Returns:
            exp(1j m 4 pi f extra / c) for every order m, shape (M, 1, 1) or (M, H, W), complex128.
        """
        extra = torch.as_tensor(extra_distance, dtype=torch.float64)
        phase = phase_from_radial_distance(extra, self.modulation_frequency)
        phase = self.orders[:, None, None] * phase
        return torch.polar(torch.ones_like(phase), phase)


class Effect:
    """An effect that the plain sensor lacks: `on_<stage>(state)` for the stages where it acts.

    One object handles all frames of a simulation, in order, so it may keep values from frame to
    frame. It draws random numbers from `state.generator` only.
    """

    name: ClassVar[str] = ""
