"""Calibration of the camera intrinsics from views of the board, by OpenCV."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from tofcorr.errors import CalibrationDataError
from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.importing.checkerboard.board import FlatBoard

# Fewest views. Set by hand: two tilted views determine the camera, five allow outliers.
_FEWEST_VIEWS = 5
# Parallel boards fit any focal length. The solver's standard deviations do not show it, because it
# stops somewhere along a valley. So three limits, set by hand, refuse such views: the root mean
# square tilt of the boards, degrees; the focal length in multiples of the longer image side; and
# its relative standard deviation.
_SMALLEST_TILT_DEG = 5.0
_FOCAL_LENGTHS_OF_IMAGE = (0.2, 20.0)
_LARGEST_RELATIVE_DEVIATION = 0.2

# Limits of the search for outliers, set by hand: rounds; smallest share of corners that a view must
# keep; reprojection error of an outlier in standard deviations, and at least, in pixels.
_MAX_ROUNDS = 5
_SMALLEST_SHARE_OF_CORNERS = 0.8
_OUTLIER_DEVIATIONS = 5.0
_SMALLEST_OUTLIER_PIXELS = 0.4
# Median length of a two-dimensional normal vector, in standard deviations of one coordinate:
# sqrt(2 ln 2).
_RAYLEIGH_MEDIAN = 1.1774


@dataclass(frozen=True, kw_only=True)
class IntrinsicsCalibration:
    """Calibrated camera intrinsics.

    Attributes:
        camera: The intrinsics, with distortion k1 k2 p1 p2 k3.
        reprojection_rms: Root mean square reprojection error of the corners used, pixels.
        standard_deviations: Of fx, fy, cx, cy (pixels), k1, k2, p1, p2, k3; shape (9,).
        num_views: Number of views used.
        num_outliers: Number of corners left out.
    """

    camera: CameraIntrinsics
    reprojection_rms: float
    standard_deviations: np.ndarray
    num_views: int
    num_outliers: int

    def warning(self) -> str:
        """Return a sentence on how the uncertainty of the focal length affects distances."""
        focal_length = self.camera.matrix[0][0]
        deviation = self.standard_deviations[0]
        return (
            f"The focal length calibrated from {self.num_views} views is {focal_length:.1f} ± "
            f"{deviation:.1f} px (one standard deviation); by itself that leaves the slope of the "
            f"distance error uncertain by {1e3 * deviation / focal_length:.1f} mm/m."
        )


def calibrate(
    corner_sets: list[np.ndarray], board: FlatBoard, size: tuple[int, int]
) -> IntrinsicsCalibration:
    """Calibrate focal lengths, principal point and distortion; leave out outlying corners.

    Args:
        corner_sets: Corners of each view in the order of `FlatBoard.corner_points`, shapes (N, 2);
            NaN for corners that are hidden.
        board: The board.
        size: Width and height of the images.

    Raises:
        CalibrationDataError: There are too few views, or they do not determine the camera.
    """
    if len(corner_sets) < _FEWEST_VIEWS:
        raise CalibrationDataError(
            f"{len(corner_sets)} views show the board; at least {_FEWEST_VIEWS} are needed to "
            "calibrate the camera. Record more, at several tilts, or give the intrinsics."
        )
    chosen = [np.asarray(np.isfinite(corners).all(axis=1)) for corners in corner_sets]
    calibration, errors = _solve(corner_sets, chosen, board, size)
    for _ in range(_MAX_ROUNDS):
        limit = _outlier_limit(errors)
        # An outlier shifts its whole view, so the best corners of each view are always kept.
        inliers = [
            error <= max(limit, np.nanquantile(error, _SMALLEST_SHARE_OF_CORNERS))
            for error in errors
        ]
        if all(np.array_equal(a, b) for a, b in zip(inliers, chosen, strict=True)):
            break
        chosen = inliers
        calibration, errors = _solve(corner_sets, chosen, board, size)
    limit = _outlier_limit(errors)
    keep = [
        i
        for i, error in enumerate(errors)
        if (error[np.isfinite(error)] <= limit).mean() >= _SMALLEST_SHARE_OF_CORNERS
    ]
    if len(keep) == len(corner_sets):
        return calibration
    if len(keep) < _FEWEST_VIEWS:
        raise CalibrationDataError(
            f"only {len(keep)} of {len(corner_sets)} views fit one camera; at least "
            f"{_FEWEST_VIEWS} are needed. Is the board flat, and its size right?"
        )
    return _solve([corner_sets[i] for i in keep], [chosen[i] for i in keep], board, size)[0]


def _outlier_limit(errors: list[np.ndarray]) -> float:
    deviation = float(np.nanmedian(np.concatenate(errors))) / _RAYLEIGH_MEDIAN
    return max(_SMALLEST_OUTLIER_PIXELS, _OUTLIER_DEVIATIONS * deviation)


def _solve(
    corner_sets: list[np.ndarray], used: list[np.ndarray], board: FlatBoard, size: tuple[int, int]
) -> tuple[IntrinsicsCalibration, list[np.ndarray]]:
    points = board.corner_points()
    try:
        rms, matrix, distortion, rotations, translations, deviations, _, _ = (
            cv2.calibrateCameraExtended(
                [points[u].astype(np.float32) for u in used],
                [c[u].astype(np.float32) for c, u in zip(corner_sets, used, strict=True)],
                size,
                np.eye(3),
                np.zeros(5),
            )
        )
    except cv2.error as error:
        raise CalibrationDataError(
            f"OpenCV cannot calibrate the camera from these views ({error.err}); "
            "tilt the board about both axes, or give the intrinsics."
        ) from None
    distortion = distortion.ravel()[:5]
    deviations = deviations.ravel()[:9]
    _refuse_undetermined(matrix, deviations, rotations, size)
    errors = [
        np.linalg.norm(
            cv2.projectPoints(points, rotation, translation, matrix, distortion)[0][:, 0] - corners,
            axis=1,
        )
        for corners, rotation, translation in zip(corner_sets, rotations, translations, strict=True)
    ]
    rows = [[float(value) for value in row] for row in matrix]
    calibration = IntrinsicsCalibration(
        camera=CameraIntrinsics(
            width=size[0],
            height=size[1],
            matrix=((rows[0][0], 0.0, rows[0][2]), (0.0, rows[1][1], rows[1][2]), (0.0, 0.0, 1.0)),
            distortion=tuple(float(value) for value in distortion),
        ),
        reprojection_rms=float(rms),
        standard_deviations=deviations,
        num_views=len(used),
        num_outliers=sum(
            int((np.isfinite(c).all(axis=1) & ~u).sum())
            for c, u in zip(corner_sets, used, strict=True)
        ),
    )
    return calibration, errors


def _refuse_undetermined(
    matrix: np.ndarray,
    deviations: np.ndarray,
    rotations: Sequence[np.ndarray],
    size: tuple[int, int],
) -> None:
    focal_lengths = np.array([matrix[0, 0], matrix[1, 1]])
    low, high = (factor * max(size) for factor in _FOCAL_LENGTHS_OF_IMAGE)
    sound = np.isfinite(matrix).all() and np.isfinite(deviations).all()
    sound &= bool(np.all((focal_lengths > low) & (focal_lengths < high)))
    sound &= bool(np.all(deviations[:2] < _LARGEST_RELATIVE_DEVIATION * focal_lengths))
    tilt = _rms_tilt_deg(rotations)
    if not sound or tilt < _SMALLEST_TILT_DEG:
        raise CalibrationDataError(
            "these views do not determine the camera: the board's tilts vary by "
            f"{tilt:.1f} degrees ({_SMALLEST_TILT_DEG:g} needed), and the focal length came out as "
            f"{matrix[0, 0]:.4g} ± {deviations[0]:.2g} px for images of {size[0]}x{size[1]}; "
            "tilt the board about both axes, or give the intrinsics."
        )


def _rms_tilt_deg(rotations: Sequence[np.ndarray]) -> float:
    """Return the root mean square angle between the boards' normals and their mean."""
    normals = np.stack([cv2.Rodrigues(rotation)[0][:, 2] for rotation in rotations])
    mean = normals.mean(axis=0)
    cosines = np.clip(normals @ mean / np.linalg.norm(mean), -1.0, 1.0)
    return float(np.degrees(np.sqrt(np.mean(np.arccos(cosines) ** 2))))
