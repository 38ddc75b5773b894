"""Shift with the temperature of the room."""

import math
from itertools import pairwise
from typing import ClassVar, Self

import torch
from torch import Tensor

from tofcorr.options import Options
from tofcorr.simulation.effects.base import CatalogueEffect, Coefficient
from tofcorr.simulation.effects.inputs import ROOM_TEMPERATURE, EffectInputs, inputs_from_state
from tofcorr.simulation.hooks import FrameState

# Largest number of pauses after which an unknown temperature is assumed. Set by hand: each adds a
# coefficient.
_MOST_PAUSES = 5


class RoomTemperatureShape(Options):
    """Temperature without shift, time constants of the lag, and times without known history."""

    reference_c: float = 22.0
    lags_s: tuple[float, ...] = (200.0, 800.0)
    starts_s: tuple[float, ...] = (0.0,)


class RoomTemperatureEffect(CatalogueEffect):
    r"""A shift with the room temperature, immediate and lagged.

    .. math:: \Delta d = a (\vartheta - \vartheta_0)
              + \sum_T b_T \Big(\bar\vartheta_T - \vartheta_0
              + \sum_{j: t_j \le t} s_j e^{-(t - t_j) / T}\Big) + q (\vartheta - \vartheta_0)^2

    with first-order lagged temperatures of the time constants T in `lags_s`. The temperature before
    the first frame and during long pauses is not recorded: after each of them, at t_j, the camera's
    temperature deviates by s_j degrees. About 8 mm per degree (Kahlmann et al. 2006).
    """

    name = "room_temperature"
    summary = "shift with the temperature of the room"
    source = "Kahlmann et al. 2006"
    remedy = "the same poses at room temperatures at least 3 degrees apart, logged"
    needs = (ROOM_TEMPERATURE,)
    of_frame = True
    shape_type: ClassVar[type[Options]] = RoomTemperatureShape

    def __init__(self, shape: Options, coefficients: Tensor | None = None) -> None:
        super().__init__(shape, coefficients)
        self._seen: list[tuple[float, float]] = []

    @classmethod
    def for_recording(cls, inputs: EffectInputs) -> Self:
        """Take the mean temperature as reference, and the times after the longest pauses."""
        room, times = inputs.facts.room_temperature, inputs.facts.timestamp.sort().values
        shape = RoomTemperatureShape(reference_c=22.0 if room is None else float(room.mean()))
        pauses = times.diff()
        longest = pauses.argsort(descending=True)[:_MOST_PAUSES].sort().values
        after = [times[i + 1] for i in longest if pauses[i] > min(shape.lags_s)]
        starts = tuple(float(time) for time in [times[0], *after])
        return cls(shape.model_copy(update={"starts_s": starts}))

    @classmethod
    def terms(cls, shape: RoomTemperatureShape) -> tuple[Coefficient, ...]:
        """Return the coefficients of immediate, lagged, squared and earlier temperature."""
        lagged = [Coefficient(f"lagged_{lag:g}s_per_degree", "m/K", 0.008) for lag in shape.lags_s]
        return (
            Coefficient("per_degree", "m/K", 0.008),
            *lagged,
            Coefficient("square", "m/K^2", 0.001),
            *(Coefficient(f"start_{i}", "K", 1.5) for i, _ in enumerate(shape.starts_s)),
        )

    def in_other_recordings(self) -> Self:
        """Return the effect without the unknown temperatures before the first frame and pauses.

        At those moments of another recording they once added 30 mm.
        """
        count = len(self.shape.starts_s)
        shape = self.shape.model_copy(update={"starts_s": ()})
        return type(self)(shape, self.coefficients[: len(self.coefficients) - count])

    def shift(self, inputs: EffectInputs, coefficients: Tensor) -> Tensor:
        """Return the shift of each pixel's frame, shape (M,), metres."""
        room = inputs.facts.room_temperature
        if room is None:
            raise ValueError("The room temperature is unknown; room_temperature needs it.")
        return inputs.of_frame(self._shifts(inputs.facts.timestamp, room, coefficients))

    def on_delay(self, state: FrameState) -> None:
        """Delay the frame, given the temperatures of the frames before it."""
        facts = inputs_from_state(state).facts
        if facts.room_temperature is None:
            raise ValueError("The room temperature is unknown; room_temperature needs it.")
        self._seen.append((float(facts.timestamp[0]), float(facts.room_temperature[0])))
        times, room = torch.tensor(self._seen, dtype=torch.float64).unbind(-1)
        state.delay = state.delay + self._shifts(times, room, self.coefficients)[-1]

    def _shifts(self, times: Tensor, room: Tensor, coefficients: Tensor) -> Tensor:
        lags, starts = self.shape.lags_s, self.shape.starts_s
        at_once, square = coefficients[0], coefficients[1 + len(lags)]
        excess = room - self.shape.reference_c
        shift = at_once * excess + square * excess**2
        for strength, lag in zip(coefficients[1:], lags, strict=False):
            followed = lagged_by(lag, times, excess)
            for off, start in zip(coefficients[2 + len(lags) :], starts, strict=True):
                since = times - start
                lingering = torch.exp(-since.clamp(min=0.0) / lag) * (since >= 0)
                followed = followed + off * lingering
            shift = shift + strength * followed
        return shift


def lagged_by(lag_s: float, times: Tensor, values: Tensor) -> Tensor:
    """Return the first-order lag of values (F,); before the earliest time they are constant.

    Between frames the values change linearly from v_0 to v. The solution of y' = (v(t) - y) / T is
    y = v + (y_0 - v_0) e - (v - v_0) (1 - e) T / t with e = exp(-t / T).
    """
    order = torch.argsort(times, stable=True)
    at, given = times[order].tolist(), values[order].tolist()
    followed = given[:1]
    for (start, end), (first, last) in zip(pairwise(at), pairwise(given), strict=True):
        passed = (end - start) / lag_s
        behind = -math.expm1(-passed) / passed if passed > 0 else 1.0
        followed.append(last + (followed[-1] - first) * math.exp(-passed) - (last - first) * behind)
    lagged = torch.empty_like(values)
    lagged[order] = values.new_tensor(followed)
    return lagged
