"""A time difference between images and poses."""

from dataclasses import replace
from typing import Self

from torch import Tensor

from tofcorr.geometry.se3 import small_motion
from tofcorr.options import Options
from tofcorr.simulation.effects.base import (
    VELOCITY,
    Coefficient,
    EffectInputs,
    GeometryEffect,
    known,
)
from tofcorr.simulation.hooks import FrameFacts


class TimestampOffsetShape(Options):
    """Middle and half of the time over which clocks drift, and whether exposures are known."""

    middle_s: float = 0.0
    half_s: float = 1.0
    knows_exposure: bool = False


class TimestampOffsetEffect(GeometryEffect, shape=TimestampOffsetShape):
    r"""The image is taken some time after the recorded pose.

    .. math:: T' = T \exp(\hat\xi\, \Delta t), \quad
              \Delta t = t_0 + t_1 (t - \bar t) / h + a \tau

    for the twist xi of the tool. The clocks of camera and robot differ by t_0. Where one runs
    faster, that difference changes by 2 t_1 over the recording, whose middle is at t-bar and whose
    half length is h. A stamp may tell when a frame was asked for, which takes a times the
    integration time tau: a camera takes 4 to 24 exposures for a frame.

    Source: rigid motion at constant twist.
    """

    name = "timestamp_offset"
    summary = "a time difference between images and poses"
    remedy = "the same path in both directions, or poses at rest"
    needs = (VELOCITY,)

    @classmethod
    def for_recording(cls, inputs: EffectInputs) -> Self:
        """Take the time that the recording lasted, and integration times where they differ."""
        times, exposure = inputs.facts.timestamp, inputs.facts.integration_time
        first, last = float(times.min()), float(times.max())
        # It differs, and is known of every frame.
        known = exposure is not None and bool(exposure.max() > exposure.min())
        middle, half = (first + last) / 2, (last - first) / 2 or 1.0
        return cls(TimestampOffsetShape(middle_s=middle, half_s=half, knows_exposure=known))

    @classmethod
    def terms(cls, shape: TimestampOffsetShape) -> tuple[Coefficient, ...]:
        """Return the delay of the images, its drift, and its share of the exposure if known."""
        times = Coefficient("offset_s", "s", 0.2), Coefficient("half_of_drift_s", "s", 0.1)
        return (*times, Coefficient("exposures", "1", 12.0)) if shape.knows_exposure else times

    def in_other_recordings(self) -> Self:
        """Return the effect without the drift, which belongs to the hours of one recording."""
        kept = self.coefficients.clone()
        kept[1] = 0.0
        return self.with_coefficients(kept)

    def moved(self, facts: FrameFacts, coefficients: Tensor) -> FrameFacts:
        """Move the tool to its pose at the time of the image."""
        if facts.tool_twist is None:
            return facts
        shape, c, twist = self.shape, coefficients, facts.tool_twist.nan_to_num(0.0)
        late = c[0] + c[1] * (facts.timestamp - shape.middle_s) / shape.half_s
        if shape.knows_exposure:
            late = late + c[2] * known(facts, "integration_time")
        later = facts.world_from_tool @ small_motion(twist * late[:, None])
        return replace(facts, world_from_tool=later)
