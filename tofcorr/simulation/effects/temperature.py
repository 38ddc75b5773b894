"""Shifts with the temperature of camera and room, which follow what was before."""

from typing import Self

import torch
from torch import Tensor

from tofcorr.options import Options
from tofcorr.simulation.effects.base import (
    ROOM_TEMPERATURE,
    TIMESTAMP,
    Coefficient,
    EffectInputs,
    FrameEffect,
    known,
)
from tofcorr.simulation.hooks import FrameFacts

# A pause of more mean intervals between frames than this counts as one that the camera was off in,
# beyond them. Chosen: stations of a robot differ less, and a camera between them is left on.
_ON_INTERVALS = 3.0
# Largest number of pauses after which an unknown temperature is assumed. Set by hand: each adds a
# coefficient.
_MOST_PAUSES = 5


class WarmUpShape(Options):
    """Time constants, the mean time between frames, and the reference of the body temperature."""

    rise_s: tuple[float, ...] = (60.0, 200.0, 600.0, 1800.0)
    heat_s: tuple[float, ...] = (120.0, 600.0)
    frame_interval_s: float = 10.0
    body_reference_c: float | None = None


class WarmUpEffect(FrameEffect, shape=WarmUpShape):
    r"""Drift with the time since power-on, and with the heat of the time that the camera ran.

    .. math:: \Delta d_i = \sum_T k_T (1 - e^{-t_i / T})
              + \sum_T h_T \sum_{j \le i} (1 - e^{-\delta_j / T}) e^{-(t_i - t_j) / T}
              + b (\vartheta_i - \vartheta_{room,i} - \vartheta_0) / 10 K

    The first sum is an uninterrupted warm-up. The second also cools down in pauses: the camera runs
    for the time delta_j since the frame before, but for three mean intervals at most, so that it
    does not matter how often it was recorded. The last term follows the body temperature if it is
    recorded, relative to the room temperature if that is known too; the effect of the room itself
    is `room_temperature`. About 15 mm within three frames (Abdo and Borgeat 2010).

    Source: Kahlmann et al. 2006; Abdo and Borgeat 2010.
    """

    name = "warm_up"
    summary = "drift while the camera warms up and cools down between frames"
    remedy = "random poses with revisits, the first minutes included, body temperature logged"
    needs = (TIMESTAMP,)
    linear = True

    @classmethod
    def for_recording(cls, inputs: EffectInputs) -> Self:
        """Take the mean frame interval; use the body temperature if every frame has one."""
        times, body = inputs.facts.timestamp, _excess(inputs.facts)
        interval = float(times.max() - times.min()) / max(len(times) - 1, 1)
        reference = None
        if body is not None and bool(body.isfinite().all()):
            reference = float(body.mean())
        return cls(WarmUpShape(frame_interval_s=interval or 1.0, body_reference_c=reference))

    @classmethod
    def terms(cls, shape: WarmUpShape) -> tuple[Coefficient, ...]:
        """Return one coefficient per time constant, and one of the body temperature if known."""
        names = [f"rise_{t:g}s" for t in shape.rise_s] + [f"heat_{t:g}s" for t in shape.heat_s]
        names += [] if shape.body_reference_c is None else ["body_10k"]
        return tuple(Coefficient(name, "m", cls.prior) for name in names)

    def shifts(self, facts: FrameFacts, coefficients: Tensor) -> Tensor:
        """Return the drift of each frame, shape (F,), metres."""
        shape, times = self.shape, facts.timestamp
        drifts = [1 - torch.exp(-times / constant) for constant in shape.rise_s]
        drifts += heats(times, shape)
        if shape.body_reference_c is not None:
            known(facts, "body_temperature")
            drifts.append((_excess(facts) - shape.body_reference_c) / 10.0)
        return torch.stack(drifts, dim=-1) @ coefficients


def heats(times: Tensor, shape: WarmUpShape) -> list[Tensor]:
    """Return the heat at the times (F,) of frames for each time constant, 0 cold to 1 warm."""
    ordered, order = times.sort(stable=True)
    since = ordered.diff(prepend=ordered[:1]).clamp(max=_ON_INTERVALS * shape.frame_interval_s)
    ran = torch.empty_like(times).index_copy(0, order, since)
    return [lingering(times, times, t) @ -torch.expm1(-ran / t) for t in shape.heat_s]


def lingering(times: Tensor, moments: Tensor, constant_s: float) -> Tensor:
    """Return what is left at times (F,) of ones at moments (M,), shape (F, M); 0 before them."""
    since = times[:, None] - moments
    return torch.exp(-since.clamp(min=0.0) / constant_s) * (since >= 0)


def _excess(facts: FrameFacts) -> Tensor | None:
    """Return body minus room temperature, or body temperature alone, (F,); None if unknown."""
    body, room = facts.body_temperature, facts.room_temperature
    if body is None or room is None or not bool(torch.isfinite(room).all()):
        return body
    return body - room


class RoomTemperatureShape(Options):
    """Temperature without shift, time constants of the lag, and times without known history."""

    reference_c: float = 22.0
    lags_s: tuple[float, ...] = (200.0, 800.0)
    starts_s: tuple[float, ...] = (0.0,)


class RoomTemperatureEffect(FrameEffect, shape=RoomTemperatureShape):
    r"""A shift with the room temperature, immediate and lagged.

    .. math:: \Delta d = a (\vartheta - \vartheta_0)
              + \sum_T b_T \Big(\bar\vartheta_T - \vartheta_0
              + \sum_{j: t_j \le t} s_j e^{-(t - t_j) / T}\Big) + q (\vartheta - \vartheta_0)^2

    with first-order lagged temperatures of the time constants T in `lags_s`. The temperature before
    the first frame and during long pauses is not recorded: after each of them, at t_j, the camera's
    temperature deviates by s_j degrees. About 8 mm per degree (Kahlmann et al. 2006).

    Source: Kahlmann et al. 2006.
    """

    name = "room_temperature"
    summary = "shift with the temperature of the room"
    remedy = "the same poses at room temperatures at least 3 degrees apart, logged"
    needs = (ROOM_TEMPERATURE,)
    prior, prior_start = 0.008, 1.5

    @classmethod
    def for_recording(cls, inputs: EffectInputs) -> Self:
        """Take the mean temperature as reference, and the times after the longest pauses."""
        room, times = known(inputs.facts, "room_temperature"), inputs.facts.timestamp.sort().values
        pauses, least = times.diff(), min(RoomTemperatureShape().lags_s)
        longest = pauses.argsort(descending=True)[:_MOST_PAUSES].sort().values
        after = [float(times[i + 1]) for i in longest if pauses[i] > least]
        starts = (float(times[0]), *after)
        return cls(RoomTemperatureShape(reference_c=float(room.mean()), starts_s=starts))

    @classmethod
    def terms(cls, shape: RoomTemperatureShape) -> tuple[Coefficient, ...]:
        """Return the coefficients of immediate, lagged, squared and earlier temperature."""
        slopes = ["per_degree", *(f"lagged_{lag:g}s_per_degree" for lag in shape.lags_s)]
        starts = [f"start_{i}" for i in range(len(shape.starts_s))]
        return (
            *(Coefficient(name, "m/K", cls.prior) for name in slopes),
            Coefficient("square", "m/K^2", cls.prior / 8),
            *(Coefficient(name, "K", cls.prior_start) for name in starts),
        )

    def in_other_recordings(self) -> Self:
        """Return the effect without the unknown temperatures before the first frame and pauses.

        At those moments of another recording they once added 30 mm.
        """
        shape = self.shape.model_copy(update={"starts_s": ()})
        return type(self)(shape, self.coefficients[: len(self.terms(shape))])

    def shifts(self, facts: FrameFacts, coefficients: Tensor) -> Tensor:
        """Return the shift of each frame, shape (F,), metres."""
        times, room = facts.timestamp, known(facts, "room_temperature")
        lags, starts = self.shape.lags_s, self.shape.starts_s
        at_once, lagged, square, off = coefficients.split([1, len(lags), 1, len(starts)])
        excess = room - self.shape.reference_c
        shift = at_once * excess + square * excess**2
        for strength, lag in zip(lagged, lags, strict=True):
            unknown = lingering(times, times.new_tensor(starts), lag) @ off
            shift = shift + strength * (lagged_by(lag, times, excess) + unknown)
        return shift


def lagged_by(lag_s: float, times: Tensor, values: Tensor) -> Tensor:
    """Return the first-order lag of values (F,); before the earliest time they are constant.

    Between frames the values change linearly from v_0 to v. The solution of y' = (v(t) - y) / T is
    y = v + (y_0 - v_0) e - (v - v_0) (1 - e) T / t with e = exp(-t / T): y is behind v by what is
    left of all changes before.
    """
    ordered, order = times.sort(stable=True)
    given, passed = values[order], ordered.diff() / lag_s
    behind = given.diff() * torch.where(passed > 0, -torch.expm1(-passed) / passed, 1.0)
    left = torch.exp(-(ordered[:, None] - ordered[1:]) / lag_s).tril(-1)
    return torch.empty_like(values).index_copy(0, order, given - left @ behind)
