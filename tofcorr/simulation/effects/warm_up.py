"""Drift while the camera warms up."""

from typing import ClassVar, Self

import torch
from torch import Tensor

from tofcorr.options import Options
from tofcorr.simulation.effects.base import Coefficient, LinearDelay
from tofcorr.simulation.effects.inputs import TIMESTAMP, EffectInputs, FrameFacts, inputs_from_state
from tofcorr.simulation.hooks import FrameState

# A pause of more mean intervals between frames than this counts as one that the camera was off in,
# beyond them. Chosen: stations of a robot differ less, and a camera between them is left on.
_ON_INTERVALS = 3.0


class WarmUpShape(Options):
    """Time constants, the mean time between frames, and the reference of the body temperature."""

    rise_s: tuple[float, ...] = (60.0, 200.0, 600.0, 1800.0)
    heat_s: tuple[float, ...] = (120.0, 600.0)
    frame_interval_s: float = 10.0
    body_reference_c: float | None = None


class WarmUpEffect(LinearDelay):
    r"""Drift with the time since power-on, and with the heat of the time that the camera ran.

    .. math:: \Delta d_i = \sum_T k_T (1 - e^{-t_i / T})
              + \sum_T h_T \sum_{j \le i} (1 - e^{-\delta_j / T}) e^{-(t_i - t_j) / T}
              + b (\vartheta_i - \vartheta_{room,i} - \vartheta_0) / 10 K

    The first sum is an uninterrupted warm-up. The second also cools down in pauses: the camera runs
    for the time delta_j since the frame before, but for three mean intervals at most, so that it
    does not matter how often it was recorded. The last term follows the body temperature if it is
    recorded, relative to the room temperature if that is known too; the effect of the room itself
    is `room_temperature`. About 15 mm within three frames (Abdo and Borgeat 2010).
    """

    name = "warm_up"
    summary = "drift while the camera warms up and cools down between frames"
    source = "Kahlmann et al. 2006; Abdo and Borgeat 2010"
    remedy = (
        "poses in random order with revisits, the first minutes included, body temperature logged"
    )
    needs = (TIMESTAMP,)
    of_frame = True
    shape_type: ClassVar[type[Options]] = WarmUpShape

    def __init__(self, shape: Options, coefficients: Tensor | None = None) -> None:
        super().__init__(shape, coefficients)
        self._timestamps: list[float] = []

    @classmethod
    def for_recording(cls, inputs: EffectInputs) -> Self:
        """Take the mean frame interval; use the body temperature if every frame has one."""
        times, body = inputs.facts.timestamp, _excess(inputs.facts)
        interval = float(times.max() - times.min()) / max(len(times) - 1, 1)
        reference = None
        if body is not None and bool(torch.isfinite(body).all()):
            reference = float(body.mean())
        shape = WarmUpShape(frame_interval_s=max(interval, 1e-3), body_reference_c=reference)
        return cls(shape)

    @classmethod
    def terms(cls, shape: WarmUpShape) -> tuple[Coefficient, ...]:
        """Return one coefficient per time constant, and one of the body temperature if known."""
        rise = [Coefficient(f"rise_{t:g}s", "m", 0.02) for t in shape.rise_s]
        heat = [Coefficient(f"heat_{t:g}s", "m", 0.02) for t in shape.heat_s]
        known = shape.body_reference_c is not None
        body = [Coefficient("body_10k", "m", 0.02)] if known else []
        return (*rise, *heat, *body)

    def columns(self, inputs: EffectInputs) -> Tensor:
        """Return the drift of each pixel's frame, shape (M, K)."""
        facts = inputs.facts
        return inputs.of_frame(self._drifts(facts.timestamp, facts))

    def on_delay(self, state: FrameState) -> None:
        """Delay the frame by its drift, which depends on the frames before it."""
        inputs = inputs_from_state(state)
        self._timestamps.append(float(inputs.facts.timestamp[0]))
        times = torch.tensor(self._timestamps, dtype=torch.float64)
        drift = self._drifts(times, inputs.facts)[-1] @ self.coefficients
        state.delay = state.delay + drift

    def _drifts(self, times: Tensor, facts: FrameFacts) -> Tensor:
        shape = self.shape
        rise = [1 - torch.exp(-times / constant) for constant in shape.rise_s]
        drifts = [*rise, *_heats(times, shape)]
        if shape.body_reference_c is not None:
            excess = _excess(facts)
            if excess is None:
                raise ValueError("warm_up was fitted with body temperatures, which are unknown.")
            drifts.append(((excess - shape.body_reference_c) / 10.0).expand(len(times)))
        return torch.stack(drifts, dim=-1)


def _heats(times: Tensor, shape: WarmUpShape) -> list[Tensor]:
    """Return the heat at the times (F,) of frames for each time constant, 0 cold to 1 warm."""
    age = times[:, None] - times[None, :]
    past = age >= 0
    order = times.argsort(stable=True)
    since = (
        times[order]
        .diff(prepend=times[order][:1])
        .clamp(max=_ON_INTERVALS * shape.frame_interval_s)
    )
    ran = torch.empty_like(times).index_copy(0, order, since)
    return [
        (torch.exp(-age.clamp(min=0) / constant) * past) @ -torch.expm1(-ran / constant)
        for constant in shape.heat_s
    ]


def _excess(facts: FrameFacts) -> Tensor | None:
    """Return body minus room temperature, or body temperature alone, (F,); None if unknown."""
    body, room = facts.body_temperature, facts.room_temperature
    if body is None or room is None or not bool(torch.isfinite(room).all()):
        return body
    return body - room
