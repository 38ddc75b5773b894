"""Whether depth and poses can be in metres, as they are said to be."""

import numpy as np

from tofcorr.errors import CalibrationDataError

_FARTHEST_DEPTH = 50.0
"""Metres: farther than any time-of-flight camera on a robot; 0.05 m read as millimetres is 50."""

_NEAREST_DEPTH = 0.03
"""Metres: below it even single-pixel sensors give no distance; depth in kilometres, or a unit given
twice, does."""

_FARTHEST_MOVE = 50.0
"""Metres between two poses of one recording: beyond any arm, and most rooms."""

_SMALLEST_MOVE = 1e-3
"""Metres (or radians) that some pose must differ by: below it no hand-eye transform is revealed."""


def refuse_impossible_depth(median_depth: np.ndarray, origin: str) -> None:
    """Refuse depth that is not in metres.

    Args:
        median_depth: Median of each image, shape (I,), as metres; NaN without returns.
        origin: For the message.

    Raises:
        CalibrationDataError: No image has a return, or the typical depth is impossible.
    """
    seen = median_depth[np.isfinite(median_depth)]
    if not seen.size:
        raise CalibrationDataError(f"{origin}: no image has a pixel with a return.")
    typical = float(np.median(seen))
    if typical > _FARTHEST_DEPTH:
        raise CalibrationDataError(
            f"{origin}: the median depth is {typical:.4g} m. Is it in millimetres? Add "
            "--depth-unit-mm 1."
        )
    if typical < _NEAREST_DEPTH:
        raise CalibrationDataError(
            f"{origin}: the median depth is {1e3 * typical:.3g} mm. Is it in metres? Add "
            "--depth-unit-mm 1000."
        )


def refuse_impossible_poses(world_from_tool: np.ndarray, origin: str) -> None:
    """Refuse poses that do not move, or that are not in metres.

    Raises:
        CalibrationDataError: As said.
    """
    place = world_from_tool[:, :3, 3]
    extent = float(np.linalg.norm(place.max(axis=0) - place.min(axis=0)))
    turned = float(np.abs(world_from_tool[:, :3, :3] - world_from_tool[0, :3, :3]).max())
    if extent > _FARTHEST_MOVE:
        raise CalibrationDataError(
            f"{origin}: the tool moves over {extent:.4g} m. Are the translations in millimetres? "
            "Expected metres (in CSV, columns tx_mm, ty_mm, tz_mm are scaled)."
        )
    if extent < _SMALLEST_MOVE and turned < _SMALLEST_MOVE:
        raise CalibrationDataError(
            f"{origin}: all poses are the same to {1e3 * extent:.2g} mm; expected a robot that "
            "moves and turns the camera."
        )
