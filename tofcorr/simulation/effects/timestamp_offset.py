"""A time difference between images and poses."""

from typing import ClassVar, Self

import torch
from torch import Tensor

from tofcorr.geometry import se3
from tofcorr.options import Options
from tofcorr.simulation.effects.base import Coefficient, GeometryEffect
from tofcorr.simulation.effects.inputs import VELOCITY, EffectInputs, FrameFacts, facts_from_state
from tofcorr.simulation.hooks import FrameState

# Least half length of a recording, seconds: far below the time between two frames. Set by hand.
_SHORTEST_S = 1e-6


class TimestampOffsetShape(Options):
    """Middle and half of the time over which clocks drift, and whether exposures are known."""

    middle_s: float = 0.0
    half_s: float = 1.0
    knows_exposure: bool = False


class TimestampOffsetEffect(GeometryEffect):
    r"""The image is taken some time after the recorded pose.

    .. math:: T' = T \exp(\hat\xi\, \Delta t), \quad
              \Delta t = t_0 + t_1 (t - \bar t) / h + a \tau

    for the twist xi of the tool. The clocks of camera and robot differ by t_0. Where one runs
    faster, that difference changes by 2 t_1 over the recording, whose middle is at t-bar and whose
    half length is h. A stamp may tell when a frame was asked for, which takes a times the
    integration time tau: a camera takes 4 to 24 exposures for a frame.
    """

    name = "timestamp_offset"
    summary = "a time difference between images and poses"
    source = "rigid motion at constant twist"
    remedy = "the same path in both directions, or poses at rest"
    needs = (VELOCITY,)
    shape_type: ClassVar[type[Options]] = TimestampOffsetShape

    @classmethod
    def for_recording(cls, inputs: EffectInputs) -> Self:
        """Take the time that the recording lasted, and integration times where they differ."""
        times, exposure = inputs.facts.timestamp, inputs.facts.integration_time
        first, last = float(times.min()), float(times.max())
        differs = False
        if exposure is not None and bool(exposure.isfinite().all()):
            differs = float(exposure.max()) > float(exposure.min())
        return cls(
            TimestampOffsetShape(
                middle_s=(first + last) / 2,
                half_s=max((last - first) / 2, _SHORTEST_S),
                knows_exposure=differs,
            )
        )

    @classmethod
    def terms(cls, shape: TimestampOffsetShape) -> tuple[Coefficient, ...]:
        """Return the delay of the images, its drift, and its share of the exposure if known."""
        known = (Coefficient("exposures", "1", 12.0),) if shape.knows_exposure else ()
        return (Coefficient("offset_s", "s", 0.2), Coefficient("half_of_drift_s", "s", 0.1), *known)

    def in_other_recordings(self) -> Self:
        """Return the effect without the drift, which belongs to the hours of one recording."""
        kept = self.coefficients.clone()
        kept[1] = 0.0
        return self.with_coefficients(kept)

    def moved(self, facts: FrameFacts, coefficients: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Move the tool to its pose at the time of the image."""
        if facts.tool_twist is None:
            raise ValueError("The tool's velocity is unknown; timestamp_offset needs it.")
        late = self._late(facts, coefficients)[:, None]
        pose = _later(facts.world_from_tool, facts.tool_twist * late)
        return pose, facts.normal_world, facts.offset

    def on_pose(self, state: FrameState) -> None:
        """Move the tool to its pose at the time of the image."""
        if state.tool_twist is None or not bool(self.coefficients.any()):
            return
        twist = state.tool_twist[None] * self._late(facts_from_state(state), self.coefficients)
        state.world_from_tool = _later(state.world_from_tool[None], twist)[0]

    def _late(self, facts: FrameFacts, c: Tensor) -> Tensor:
        """Return how long after its pose each frame was taken, shape (F,), s."""
        shape = self.shape
        late = c[0] + c[1] * (facts.timestamp - shape.middle_s) / shape.half_s
        if not shape.knows_exposure:
            return late
        exposure = facts.integration_time
        if exposure is None:
            raise ValueError("timestamp_offset was fitted with integration times: unknown here.")
        return late + c[2] * exposure


def _later(world_from_tool: Tensor, twist: Tensor) -> Tensor:
    """Move poses (F, 4, 4) by twists (F, 6), to second order: exact to 1e-6 m at 10 cm."""
    zero = torch.zeros_like(twist[:, 0])
    x, y, z = twist[:, 3:].unbind(1)
    skew = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=1).reshape(-1, 3, 3)
    step = torch.eye(3, dtype=twist.dtype) + skew + skew @ skew / 2
    shift = twist[:, :3] + (skew @ twist[:, :3, None])[..., 0] / 2
    return world_from_tool @ se3.assemble(step, shift)
