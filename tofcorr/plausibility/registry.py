"""All checks, in the order in which they are made."""

from collections.abc import Callable

from tofcorr.plausibility.checks import (
    agreement,
    amplitude,
    depth_values,
    drifting,
    duplicates,
    exposure,
    garbage,
    lens,
    lone_walls,
    normals,
    outlying_poses,
    remounting,
    shape,
    stamps,
    stillness,
    temperatures,
    two_cameras,
    units,
)
from tofcorr.plausibility.finding import Finding
from tofcorr.plausibility.look import Look

Check = Callable[[Look], list[Finding]]

OF_VALUES: tuple[Check, ...] = (
    units.check,
    depth_values.check,
    stillness.check,
    duplicates.check,
    stamps.check,
    amplitude.check,
    temperatures.check,
    lens.check,
)
"""Those that look at values alone. What they find impossible makes those below pointless."""

OF_GEOMETRY: tuple[Check, ...] = (
    lone_walls.check,
    garbage.check,
    normals.check,
    shape.check,
    drifting.check,
    remounting.check,
    agreement.check,
    outlying_poses.check,
    two_cameras.check,
    exposure.check,
)
"""Those that compare depth, poses, planes and camera."""
