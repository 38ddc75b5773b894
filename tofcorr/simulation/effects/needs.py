"""What an effect can need to know before it can be tested, and whether it is known."""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from tofcorr.conditions import condition
from tofcorr.simulation.effects.inputs import EffectInputs


class Need(NamedTuple):
    """Something that an effect needs to know.

    Attributes:
        words: What it is called: the file, column or key of the recording format that holds it.
        known: Whether it is known for every frame.
        condition: Attribute of `Conditions`, where it is a condition of the frames.
        beyond_image: Why depth images of any scene do not hold it; empty where they do.
    """

    words: str
    known: Callable[[EffectInputs], bool]
    condition: str = ""
    beyond_image: str = ""


def _complete(values: Tensor | None) -> bool:
    return values is not None and bool(torch.isfinite(values).all())


def _condition(name: str) -> Need:
    """Return the need of a condition in every frame."""
    column = condition(name).column
    return Need(column, lambda inputs: _complete(getattr(inputs.facts, name)), condition=name)


def _moves(inputs: EffectInputs) -> bool:
    poses = inputs.facts.world_from_tool
    return bool((poses - poses[:1]).abs().amax() > 0)


def is_clock(times: Tensor) -> bool:
    """Return whether time stamps (F,) are times: those that merely count the frames are none."""
    counts = torch.arange(len(times), dtype=times.dtype, device=times.device)
    return bool(times.max() > times.min()) and not torch.equal(times, counts)


AMPLITUDE = Need("amplitude.npy", lambda inputs: inputs.amplitude is not None)
FREQUENCY = Need(
    "modulation_frequency_hz in recording.yaml",
    lambda inputs: inputs.modulation_frequency is not None,
)
INTEGRATION_TIME = _condition("integration_time")
ROOM_TEMPERATURE = _condition("room_temperature")
AMBIENT = _condition("ambient")
TIMESTAMP = Need(
    f"{condition('timestamp').column} of a clock",
    lambda inputs: is_clock(inputs.facts.timestamp),
    condition="timestamp",
)
ROBOT = Need(
    "poses of a moving tool",
    _moves,
    beyond_image="it belongs to the robot, not to the camera: render the scene from the true poses",
)
VELOCITY = Need(
    "velocity of the tool",
    lambda inputs: _complete(inputs.facts.tool_twist),
    beyond_image="an image does not hold how fast the camera moves",
)
# If the tool never moves, nothing shows whether target and room stay in place.
FIXED_TARGET = Need(
    "a target that stays in place",
    _moves,
    beyond_image="it belongs to the target and the room of the recording, which an image of "
    "another scene does not hold",
)
# A plane that the fit has to estimate is wherever the depth says.
MEASURED_PLANES = Need("measured planes", lambda inputs: inputs.planes_are_measured)
