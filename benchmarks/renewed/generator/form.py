"""What a form of an effect is: a change, of some strength, of one stage of the signal chain."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

Stage = Literal["poses", "rays", "plane", "relief", "path", "light", "taps"]
Change = Callable[[float, Any, Any], Any]


@dataclass(frozen=True)
class Form:
    """One physical form of an effect.

    `draw(rng, world)` returns `change(strength, view, value)`, which returns the stage's value with
    the effect in it; at strength zero it returns it as it is. The value is, by stage: poses the
    true world_from_tool (N, 4, 4); rays the slopes x/z, y/z (2, H, W); plane world_from_target
    (N, 4, 4); relief the target's height (N, H, W), metres; path the measured length (N, H, W),
    metres; light the phasors (N, H, W) at `view.frequency`; taps the samples (4, N, H, W) there.

    Attributes:
        effect: What an engineer calls it: a name of the program's catalogue, or of none.
        name: What tells this form from the others.
        textbook: Whether it is the form that the literature writes first. The others are those
            that a catalogue may lack.
        draw: Draws one unit's version.
        guess: A strength that gives an error of millimetres.
        scaled: Whether the strength is scaled to a size; rendered light comes as it is.
        wanted: What the design must be like, see `draw_design`.
    """

    effect: str
    name: str
    stage: Stage
    textbook: bool
    draw: Callable[[np.random.Generator, Any], Change]
    guess: float = 1.0
    scaled: bool = True
    wanted: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Hook:
    """A form drawn, at a strength."""

    form: Form
    change: Change
    strength: float
