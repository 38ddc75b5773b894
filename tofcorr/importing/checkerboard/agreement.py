"""Comparison of measured depth with the board's pose, to find wrong units and mixed-up images.

Only gross disagreement is refused (a tenth of the distance, tens of degrees). Errors of millimetres
and centimetres are what the recording is made for; they are kept.
"""

from dataclasses import dataclass

import numpy as np

from tofcorr.data.header import DepthKind
from tofcorr.errors import CalibrationDataError
from tofcorr.importing.checkerboard.board_area import true_radial_distance
from tofcorr.importing.checkerboard.pose import BoardPose
from tofcorr.importing.report import RefusedViewError

# All limits were set by hand, far beyond the errors of a working camera; on the 102 views of the
# Kinect v2 in `tests/importing/checkerboard/test_kinect2.py` they refuse at most 4.
# Fewest board pixels with depth, and their smallest share of all board pixels (no unit).
_FEWEST_PIXELS = 50
_SMALLEST_SHARE = 0.2
# Largest angle between the plane of the depth image and the board's pose, degrees. Set by
# hand: boards taken for one another, or mirrored, differ by more.
_LARGEST_TILT_DEG = 25.0
# Largest deviation from the median error of pixels used for that angle, metres: flying pixels would
# tilt the plane.
_TILT_WINDOW = 0.05
# Largest relative difference of a view's ratio of measured to true distance from that of all views.
# Set by hand: 0.1 m at 1 m is beyond any camera's error, and mixed-up images exceed it.
_LARGEST_RATIO_DEPARTURE = 0.1
# Ratio of measured to true distance (or its inverse) from which a unit must be wrong. Set
# by hand: units differ by factors of 10 and more, cameras by a tenth.
_IMPOSSIBLE_RATIO = 2.0
# Deviation of that ratio from 1 above which a warning is given. Set by hand: 5 cm at 1 m, the
# largest error that an uncalibrated camera is known for.
_SUSPICIOUS_RATIO = 0.05
# Slope above which the kind of depth is doubted: half of the 1 that a wrong kind causes.
_WRONG_KIND_SLOPE = 0.5
# Smallest standard deviation of D (1 - cosine), millimetres, at which that slope is estimated.
# Set by hand: the camera's own error, some millimetres, would pass for a slope below it.
_FEWEST_MILLIMETRES_OFF_AXIS = 5.0


@dataclass(frozen=True, kw_only=True)
class DepthAgreement:
    """Measured depth against the pose of one board.

    Attributes:
        usable_pixels: Board pixels with depth and below saturation.
        distance: Median true radial distance, metres.
        error: Median of measured minus true depth, of the kind recorded, metres.
        ratio: Median of measured over true distance.
        kind_moments: Sum over pixels of v v', shape (4, 4), metres, with v = (1, D, D (1 - cos a),
            measured minus true radial distance) and a the angle to the optical axis.
    """

    usable_pixels: int
    distance: float
    error: float
    ratio: float
    kind_moments: np.ndarray


def compare_depth(
    depth: np.ndarray,
    usable: np.ndarray,
    area: np.ndarray,
    pose: BoardPose,
    ray_directions: np.ndarray,
    depth_kind: DepthKind,
) -> DepthAgreement:
    """Compare one depth image with the board's pose.

    Args:
        depth: Shape (H, W), metres, of `depth_kind`.
        usable: Which depth values may be used, shape (H, W), bool.
        area: Which pixels see the board, shape (H, W), bool.
        pose: Pose of the board.
        ray_directions: Shape (H, W, 3).
        depth_kind: `radial` or `z`.

    Raises:
        RefusedViewError: Too few pixels have depth, or the depth has another tilt.
    """
    seen = area & usable
    share = seen.sum() / max(area.sum(), 1)
    if seen.sum() < _FEWEST_PIXELS or share < _SMALLEST_SHARE:
        raise RefusedViewError(
            f"only {seen.sum()} of {area.sum()} board pixels have depth below saturation; "
            f"{_FEWEST_PIXELS} and {_SMALLEST_SHARE:.0%} are needed"
        )
    rays = ray_directions[seen]
    cosine = rays[:, 2]
    true = true_radial_distance(pose, rays)
    measured = depth[seen] / (cosine if depth_kind == "z" else 1.0)
    _refuse_other_plane(measured[:, None] * rays, measured - true, pose)
    columns = np.stack([np.ones_like(true), true, true * (1.0 - cosine), measured - true])
    error = (measured - true) * (cosine if depth_kind == "z" else 1.0)
    return DepthAgreement(
        usable_pixels=int(seen.sum()),
        distance=float(np.median(true)),
        error=float(np.median(error)),
        ratio=float(np.median(measured / true)),
        kind_moments=columns @ columns.T,
    )


def typical_ratio(agreements: list[DepthAgreement]) -> float:
    """Return the median ratio of measured to true distance.

    Raises:
        CalibrationDataError: It is so far from 1 that a unit must be wrong.
    """
    ratio = float(np.median([agreement.ratio for agreement in agreements]))
    if not 1.0 / _IMPOSSIBLE_RATIO < ratio < _IMPOSSIBLE_RATIO:
        raise CalibrationDataError(
            f"the depth images read {ratio:.3g} times the distance at which the corners place the "
            "board; correct the unit of depth (millimetres per count) or the square length."
        )
    return ratio


def refuse_mixed_up(agreement: DepthAgreement, ratio: float) -> None:
    """Refuse a view whose ratio of measured to true distance differs much from `ratio` of all.

    Raises:
        RefusedViewError: Depth and infrared image are not of the same view, or the pose is wrong.
    """
    if abs(agreement.ratio / ratio - 1.0) > _LARGEST_RATIO_DEPARTURE:
        raise RefusedViewError(
            f"the depth image reads {agreement.ratio * agreement.distance:.3f} m where the board "
            f"stands at {agreement.distance:.3f} m, other views {ratio:.3f} times the distance; "
            "are the two images of the same view?"
        )


def agreement_warnings(agreements: list[DepthAgreement], depth_kind: DepthKind) -> list[str]:
    """Return warnings about the unit and the kind of depth."""
    warnings = []
    ratio = typical_ratio(agreements)
    if abs(ratio - 1.0) > _SUSPICIOUS_RATIO:
        warnings.append(
            f"Depth reads {100 * (ratio - 1):+.1f} % against the board: check the square length, "
            "the focal length and the unit of depth before calling it a distance error."
        )
    slope = _kind_slope(agreements)
    if slope is not None and abs(slope) > _WRONG_KIND_SLOPE:
        warnings.append(
            f"Away from the image centre the depth error grows with {slope:+.2f} of what turns "
            f"z into radial depth (0 expected, {'+1' if depth_kind == 'z' else '-1'} if the kind "
            f"is wrong): is depth really '{depth_kind}'?"
        )
    return warnings


def _kind_slope(agreements: list[DepthAgreement]) -> float | None:
    """Regress the radial error on D (1 - cosine), with a constant and D as further regressors.

    Radial depth declared as z gives +1, z depth declared as radial gives -1.
    """
    moments = sum((a.kind_moments for a in agreements), np.zeros((4, 4)))
    # After removing constant and D, D (1 - cosine) must vary enough to estimate its slope.
    explained = moments[2, :2] @ np.linalg.pinv(moments[:2, :2]) @ moments[:2, 2]
    spread = np.sqrt(max(moments[2, 2] - explained, 0.0) / moments[0, 0])
    if 1e3 * spread < _FEWEST_MILLIMETRES_OFF_AXIS:
        return None
    return float(np.linalg.solve(moments[:3, :3], moments[:3, 3])[2])


def _refuse_other_plane(points: np.ndarray, errors: np.ndarray, pose: BoardPose) -> None:
    near = points[np.abs(errors - np.median(errors)) < _TILT_WINDOW]
    if len(near) < _FEWEST_PIXELS:
        return  # Noisy depth has no tilt; `refuse_mixed_up` still checks the ratio.
    normal = np.linalg.svd(near - near.mean(axis=0), full_matrices=False)[2][2]
    cosine = min(abs(float(normal @ pose.plane()[0])), 1.0)
    tilt = float(np.degrees(np.arccos(cosine)))
    if tilt > _LARGEST_TILT_DEG:
        raise RefusedViewError(
            f"the depth image shows a plane tilted by {tilt:.0f} degrees against the board's pose; "
            "are the two images of the same view?"
        )
