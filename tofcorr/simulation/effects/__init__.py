"""The catalogue: effects that a plain sensor lacks, one a file.

Each class holds its equation and source, its coefficients with physical priors, what it needs to
know, the stage of the simulator where it acts, and its columns in a linear fit. The simulator runs
and the diagnosis fits the same class.
"""

from tofcorr.simulation.effects.ambient_light import AmbientLight
from tofcorr.simulation.effects.amplitude import Amplitude
from tofcorr.simulation.effects.base import CatalogueEffect
from tofcorr.simulation.effects.distance import Distance
from tofcorr.simulation.effects.incidence_angle import IncidenceAngle
from tofcorr.simulation.effects.integration_time import IntegrationTime
from tofcorr.simulation.effects.lens import Lens
from tofcorr.simulation.effects.maps import FixedPattern, MapEffect, RowColumnPattern
from tofcorr.simulation.effects.mixed_pixels import MixedPixels
from tofcorr.simulation.effects.motion import Motion
from tofcorr.simulation.effects.multipath import Multipath
from tofcorr.simulation.effects.pixel import Pixel
from tofcorr.simulation.effects.robot_kinematics import RobotKinematics
from tofcorr.simulation.effects.room_temperature import RoomTemperature
from tofcorr.simulation.effects.saturation import Saturation
from tofcorr.simulation.effects.stray_light import StrayLight
from tofcorr.simulation.effects.target_registration import TargetRegistration
from tofcorr.simulation.effects.target_shape import TargetShape
from tofcorr.simulation.effects.timestamp_offset import TimestampOffset
from tofcorr.simulation.effects.warm_up import WarmUp
from tofcorr.simulation.effects.wiggling import Wiggling

CATALOGUE: dict[str, type[CatalogueEffect]] = {
    effect.name: effect
    for effect in (
        *(Distance, Pixel, Amplitude, Wiggling, IntegrationTime, WarmUp, RoomTemperature),
        *(AmbientLight, IncidenceAngle, MixedPixels, Multipath, StrayLight, Saturation),
        *(FixedPattern, RowColumnPattern, Lens, TargetShape, TargetRegistration),
        *(RobotKinematics, Motion, TimestampOffset),
    )
}

__all__ = ["CATALOGUE", "CatalogueEffect", "MapEffect"]
