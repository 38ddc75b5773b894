"""All checks, in the order in which they are made: each is a function of what is looked at."""

from collections.abc import Callable, Iterator

from tofcorr.plausibility.checks import geometry, values
from tofcorr.plausibility.finding import Finding
from tofcorr.plausibility.look import Look

Check = Callable[[Look], Iterator[Finding]]

OF_VALUES: tuple[Check, ...] = (
    values.units,
    values.depth_values,
    values.stillness,
    values.duplicates,
    values.stamps,
    values.amplitude,
    values.temperatures,
    values.lens,
)
"""Those that look at values alone. What they find impossible makes those below pointless."""

OF_GEOMETRY: tuple[Check, ...] = (
    geometry.lone_walls,
    geometry.garbage,
    geometry.normals,
    geometry.shape,
    geometry.drift,
    geometry.remounting,
    geometry.agreement,
    geometry.outlying_poses,
    values.two_cameras,
    values.exposure,
)
"""Those that compare depth, poses, planes and camera."""
