"""The conditions of simulated frames: time, exposure, temperatures and background light."""

import math
from typing import Annotated

import torch
from pydantic import AfterValidator, Field

from tofcorr.data.table import COLUMN_OF
from tofcorr.options import Options
from tofcorr.simulation.hooks import FrameConditions
from tofcorr.simulation.numbers import NonNegativeNumber, Number, PositiveNumber, Range

_RECORDABLE = tuple(COLUMN_OF)


def _recordable(name: str) -> str:
    if name not in _RECORDABLE:
        raise ValueError(f"expected one of {', '.join(_RECORDABLE)}")
    return name


Recorded = Annotated[str, AfterValidator(_recordable)]


class ConditionOptions(Options):
    """How the conditions of the frames are drawn.

    Attributes:
        frame_interval_s: Mean time from frame to frame.
        interval_jitter: Largest deviation of an interval from the mean, as a share of it (uniformly
            distributed); not used in continuous motion.
        integration_time_us: One is drawn for each pose.
        ambient_counts: Background light in counts per tap at the first integration time, drawn
            for each pose between these bounds.
        room_temperature_c: Of the room at the first frame.
        room_drift_c: Amplitude of the room's temperature, which follows a sine.
        room_period_s: Period of that sine.
        body_rise_c: Temperature of the warm camera body above that of the room.
        body_time_constant_s: Time from power-on to 63 % of `body_rise_c`.
        power_on_s: Time from power-on to the first frame.
        recorded: Which optional columns the recording has; the others are left out.
    """

    frame_interval_s: PositiveNumber = 5.0
    interval_jitter: Annotated[float, Field(ge=0, lt=1)] = 0.3
    integration_time_us: Annotated[tuple[PositiveNumber, ...], Field(min_length=1)] = (500.0,)
    ambient_counts: Range = (0.0, 0.0)
    room_temperature_c: Number = 22.0
    room_drift_c: NonNegativeNumber = 0.5
    room_period_s: PositiveNumber = 1800.0
    body_rise_c: Number = 15.0
    body_time_constant_s: PositiveNumber = 600.0
    power_on_s: NonNegativeNumber = 30.0
    recorded: tuple[Recorded, ...] = _RECORDABLE


def draw_timestamps(
    options: ConditionOptions, num_frames: int, jitter: float, generator: torch.Generator
) -> list[float]:
    """Return the times of the frames in seconds, the first 0."""
    spread = 2 * torch.rand(num_frames, generator=generator, dtype=torch.float64) - 1
    intervals = options.frame_interval_s * (1 + jitter * spread)
    intervals[0] = 0.0
    return intervals.cumsum(0).tolist()


def draw_conditions(
    options: ConditionOptions,
    timestamps: list[float],
    pose_ids: list[int],
    generator: torch.Generator,
) -> list[FrameConditions]:
    """Return the conditions of each frame; frames of one pose have the same exposure and light."""
    num_poses = max(pose_ids) + 1
    levels = torch.tensor(options.integration_time_us, dtype=torch.float64)
    level = torch.randint(len(levels), (num_poses,), generator=generator)
    low, high = options.ambient_counts
    share = torch.rand(num_poses, generator=generator, dtype=torch.float64)
    exposure = levels[level] / levels[0]
    ambient = (low + (high - low) * share) * exposure
    return [
        FrameConditions(
            timestamp=time,
            integration_time=float(levels[level[pose]]) * 1e-6,
            ambient=float(ambient[pose]),
            room_temperature=_room(options, time),
            body_temperature=_room(options, time) + _rise(options, time),
        )
        for time, pose in zip(timestamps, pose_ids, strict=True)
    ]


def _room(options: ConditionOptions, time: float) -> float:
    turn = 2 * math.pi * time / options.room_period_s
    return options.room_temperature_c + options.room_drift_c * math.sin(turn)


def _rise(options: ConditionOptions, time: float) -> float:
    since_power_on = time + options.power_on_s
    return options.body_rise_c * -math.expm1(-since_power_on / options.body_time_constant_s)
