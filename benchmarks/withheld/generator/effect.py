"""What an effect is: a change, of some strength, of one stage of the signal chain."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

Stage = Literal["poses", "rays", "plane", "relief", "path", "light", "taps"]


@dataclass(frozen=True)
class Effect:
    """One physical effect.

    `change(strength, view, value)` returns the stage's value with the effect in it; at strength
    zero it returns it as it is. `view` is the part of the `View` known at that stage, `view.world`
    the scene. The value is, by stage: poses world_from_tool (N, 4, 4); rays the slopes x/z, y/z (2,
    H, W); plane world_from_target (4, 4); relief the target's height (N, H, W), metres; path the
    measured length (N, H, W), metres; light the phasors (N, H, W); taps the correlation samples (4,
    N, H, W).
    """

    name: str
    stage: Stage
    change: Callable[[float, Any, Any], Any]
    guess: float = 1.0  # a strength that gives an error of millimetres


@dataclass(frozen=True)
class Applied:
    """An effect at a strength."""

    effect: Effect
    strength: float
