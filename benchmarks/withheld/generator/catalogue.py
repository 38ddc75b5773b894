"""All effects by name."""

from collections.abc import Callable

import numpy as np

from benchmarks.withheld.generator import (
    geometry_effects,
    light_effects,
    outside_effects,
    path_effects,
    sensor_effects,
)
from benchmarks.withheld.generator.effect import Effect

Draw = Callable[[np.random.Generator], Effect]

INSIDE: dict[str, Draw] = {
    draw.__name__: draw
    for draw in (
        sensor_effects.wiggling,
        path_effects.integration_time,
        path_effects.warm_up,
        path_effects.room_temperature,
        light_effects.ambient_light,
        path_effects.incidence_angle,
        light_effects.mixed_pixels,
        light_effects.multipath,
        light_effects.stray_light,
        sensor_effects.saturation,
        path_effects.fixed_pattern,
        path_effects.row_column_pattern,
        path_effects.amplitude,
        geometry_effects.lens,
        geometry_effects.target_shape,
        geometry_effects.target_registration,
        geometry_effects.robot_kinematics,
        sensor_effects.motion,
        geometry_effects.timestamp_offset,
    )
}

OUTSIDE: dict[str, Draw] = {
    draw.__name__: draw
    for draw in (
        outside_effects.mirror_ghost,
        outside_effects.stripes,
        outside_effects.third_frame,
        outside_effects.frame_lag,
        outside_effects.corner_dent,
    )
}

NEEDS_MOTION = frozenset({"motion", "timestamp_offset"})


def draw_effect(name: str, rng: np.random.Generator) -> Effect:
    """Draw one unit's version of an effect."""
    return (INSIDE | OUTSIDE)[name](rng)
