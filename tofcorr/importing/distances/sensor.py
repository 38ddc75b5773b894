"""A sensor of one or a few zones as a camera."""

import math
import re

from tofcorr.errors import ConfigError
from tofcorr.geometry.camera import CameraIntrinsics

# Most zones a side. Set by hand: few-zone sensors have 8 (VL53L5CX), and larger ones give images
# instead of tables.
_MOST_ZONES = 64


def zones_of(text: str) -> tuple[int, int]:
    """Read columns and rows, such as `8x8`.

    Raises:
        ConfigError: The text is something else.
    """
    match = re.fullmatch(r"(\d+)x(\d+)", text.strip().lower())
    if match is None or not all(1 <= int(part) <= _MOST_ZONES for part in match.groups()):
        raise ConfigError(f"--zones must be COLUMNSxROWS, such as 1x1 or 8x8, got '{text[:40]}'.")
    return int(match[1]), int(match[2])


def sensor_camera(
    zones: tuple[int, int], field_of_view_deg: tuple[float, ...] | None
) -> CameraIntrinsics:
    """Return a pinhole camera with one pixel a zone.

    Args:
        zones: Columns and rows.
        field_of_view_deg: Of all zones together, horizontally and vertically (one number: both),
            degrees; not needed for one pixel, whose ray is the optical axis.

    Raises:
        ConfigError: A field of view is missing, or not between 0 and 180 degrees.
    """
    columns, rows = zones
    if zones == (1, 1):
        identity = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
        return CameraIntrinsics(width=1, height=1, matrix=identity)
    if field_of_view_deg is None:
        raise ConfigError(
            f"A sensor of {columns}x{rows} zones needs its field of view: --fov-deg H,V (a "
            "VL53L5CX has 45,45)."
        )
    horizontal, vertical = field_of_view_deg[0], field_of_view_deg[-1]
    if not (0 < horizontal < 180 and 0 < vertical < 180):
        raise ConfigError(f"--fov-deg must be between 0 and 180, got {field_of_view_deg}.")
    fx = columns / 2 / math.tan(math.radians(horizontal) / 2)
    fy = rows / 2 / math.tan(math.radians(vertical) / 2)
    matrix = ((fx, 0.0, (columns - 1) / 2), (0.0, fy, (rows - 1) / 2), (0.0, 0.0, 1.0))
    return CameraIntrinsics(width=columns, height=rows, matrix=matrix)
