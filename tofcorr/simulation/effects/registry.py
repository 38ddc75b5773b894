"""The catalogue of effects: one line each, `MODULE:CLASS` within this package.

The order is that of the columns in a linear fit, and decides between effects that fit equally well.
"""

from collections.abc import Iterator, Mapping, Sequence
from importlib import import_module
from typing import Any

from tofcorr.errors import ConfigError
from tofcorr.options import did_you_mean
from tofcorr.simulation.effects.base import CatalogueEffect

_EFFECTS = (
    "distance:DistanceEffect",
    "pixel:PixelEffect",
    "amplitude:AmplitudeEffect",
    "wiggling:WigglingEffect",
    "integration_time:IntegrationTimeEffect",
    "temperature:WarmUpEffect",
    "temperature:RoomTemperatureEffect",
    "ambient_light:AmbientLightEffect",
    "surface:IncidenceAngleEffect",
    "surface:GlossEffect",
    "mixed_pixels:MixedPixelsEffect",
    "multipath:MultipathEffect",
    "stray_light:StrayLightEffect",
    "saturation:SaturationEffect",
    "patterns:FixedPatternEffect",
    "patterns:RowColumnPatternEffect",
    "lens:LensEffect",
    "target_shape:TargetShapeEffect",
    "target_registration:TargetRegistrationEffect",
    "robot_kinematics:RobotKinematicsEffect",
    "robot_kinematics:BacklashEffect",
    "motion:MotionEffect",
    "timestamp_offset:TimestampOffsetEffect",
)


def _classes() -> Iterator[type[CatalogueEffect]]:
    for module, _, name in (line.partition(":") for line in _EFFECTS):
        yield getattr(import_module(f"tofcorr.simulation.effects.{module}"), name)


CATALOGUE: dict[str, type[CatalogueEffect]] = {effect.name: effect for effect in _classes()}
"""Every effect class by its name in `diagnosis.json` and in a simulator's YAML."""


def build_effects(entries: Sequence[Mapping[str, Any]]) -> tuple[CatalogueEffect, ...]:
    """Build the effects that options list.

    Args:
        entries: One mapping per effect: `name`, and its parameters.

    Raises:
        ConfigError: An entry lacks its name, its name is unknown, or a parameter is wrong.
    """
    effects, known = [], ", ".join(sorted(CATALOGUE))
    for place, entry in enumerate(entries):
        at, name = f"effects[{place}]", entry.get("name")
        if name is None:
            raise ConfigError(f"{at}: 'name' is missing; known effects: {known}.")
        if name not in CATALOGUE:
            hint = did_you_mean(str(name), CATALOGUE) or f" Known effects: {known}."
            raise ConfigError(f"{at}: there is no effect '{name}'.{hint}")
        values = {key: value for key, value in entry.items() if key != "name"}
        effects.append(CATALOGUE[name].from_mapping(values, f"{at} ({name})"))
    return tuple(effects)
