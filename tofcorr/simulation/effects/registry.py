"""The catalogue of effects: one line each, `MODULE:CLASS` within this package.

The order is that of the columns in a linear fit, and decides between effects that fit equally well.
"""

from importlib import import_module

from tofcorr.simulation.effects.base import CatalogueEffect

_EFFECTS = (
    "distance:DistanceEffect",
    "pixel:PixelEffect",
    "amplitude:AmplitudeEffect",
    "wiggling:WigglingEffect",
    "integration_time:IntegrationTimeEffect",
    "warm_up:WarmUpEffect",
    "room_temperature:RoomTemperatureEffect",
    "ambient_light:AmbientLightEffect",
    "incidence_angle:IncidenceAngleEffect",
    "gloss:GlossEffect",
    "mixed_pixels:MixedPixelsEffect",
    "multipath:MultipathEffect",
    "stray_light:StrayLightEffect",
    "saturation:SaturationEffect",
    "fixed_pattern:FixedPatternEffect",
    "row_column_pattern:RowColumnPatternEffect",
    "lens:LensEffect",
    "target_shape:TargetShapeEffect",
    "target_registration:TargetRegistrationEffect",
    "robot_kinematics:RobotKinematicsEffect",
    "backlash:BacklashEffect",
    "motion:MotionEffect",
    "timestamp_offset:TimestampOffsetEffect",
)


def _effect(line: str) -> type[CatalogueEffect]:
    module, _, name = line.partition(":")
    return getattr(import_module(f"tofcorr.simulation.effects.{module}"), name)


CATALOGUE: dict[str, type[CatalogueEffect]] = {
    effect.name: effect for effect in map(_effect, _EFFECTS)
}
"""Every effect class by its name in `diagnosis.json` and in a simulator's YAML."""
