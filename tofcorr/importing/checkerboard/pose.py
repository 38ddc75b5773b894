"""The pose of the board, from its corners."""

from dataclasses import dataclass

import cv2
import numpy as np

from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.importing.checkerboard.board import FlatBoard
from tofcorr.importing.report import RefusedViewError
from tofcorr.spread import sigma_from_mad

# A corner whose reprojection error exceeds both limits (pixels; standard deviations) is an outlier:
# glare, or a confusion with its neighbour. Set by hand.
_OUTLIER_PIXELS = 0.4
_OUTLIER_DEVIATIONS = 4.0
# Smallest share of corners that must fit one pose, and largest number of rounds. Set by hand.
_SMALLEST_SHARE_OF_CORNERS = 0.8
_MAX_ROUNDS = 10

# A plane that is small or far has two poses with similar projections. The reprojection error of the
# second must be larger by this factor, or the view is refused. Set by hand.
_AMBIGUOUS_RATIO = 1.2
# Poses whose normals differ by less than 3 degrees are the same pose. Set by hand.
_SAME_POSE_COSINE = np.cos(np.radians(3.0))


@dataclass(frozen=True, kw_only=True)
class BoardPose:
    """The board in the camera frame: x_camera = rotation x_board + translation.

    Attributes:
        rotation: Shape (3, 3).
        translation: Shape (3,), metres.
        used: Which corners are used for the pose, shape (N,), bool.
        reprojection_rms: Root mean square reprojection error of the corners used, pixels.
        plane_deviation: Standard deviation of the plane's position at the board's centre along
            its normal, metres, propagated from the reprojection errors.
    """

    rotation: np.ndarray
    translation: np.ndarray
    used: np.ndarray
    reprojection_rms: float
    plane_deviation: float

    def plane(self) -> tuple[np.ndarray, float]:
        """Return n (3,) and d in metres of n . x + d = 0 in the camera frame, n to the camera."""
        normal = self.rotation[:, 2]
        offset = -float(normal @ self.translation)
        return (normal, offset) if offset > 0 else (-normal, -offset)

    def centre(self, board: FlatBoard) -> np.ndarray:
        """Return the centre of the board in the camera frame, shape (3,), metres."""
        return self.rotation @ board.corner_points().mean(axis=0) + self.translation


def camera_arrays(camera: CameraIntrinsics) -> tuple[np.ndarray, np.ndarray]:
    """Return the pinhole matrix and the distortion as arrays for OpenCV."""
    return np.array(camera.matrix), np.array(camera.distortion, dtype=np.float64)


def estimate_pose(
    corners: np.ndarray, board: FlatBoard, camera: CameraIntrinsics, max_reprojection: float
) -> BoardPose:
    """Estimate the pose that projects the board onto its corners; leave out outliers.

    Args:
        corners: Pixel coordinates in the order of `FlatBoard.corner_points`, shape (N, 2).
        board: The board.
        camera: The camera intrinsics.
        max_reprojection: Largest root mean square reprojection error allowed, pixels.

    Raises:
        RefusedViewError: The corners do not fit a board, too many are outliers, or two different
            poses fit them almost equally well.
    """
    used = seen = np.asarray(np.isfinite(corners).all(axis=1))
    candidates = _candidates(corners, board, camera, used)
    for _ in range(_MAX_ROUNDS):
        inliers = _inliers(candidates[0], corners, board, camera)
        if np.array_equal(inliers, used):
            break
        if inliers.sum() < _SMALLEST_SHARE_OF_CORNERS * seen.sum():
            raise RefusedViewError(
                f"only {inliers.sum()} of {seen.sum()} corners fit one pose of the board"
            )
        used = inliers
        candidates = _candidates(corners, board, camera, used)
    _check(candidates, max_reprojection)
    return candidates[0]


def refit_pose(
    corners: np.ndarray, board: FlatBoard, camera: CameraIntrinsics, used: np.ndarray
) -> BoardPose:
    """Return the best pose for the corners `used` (bool, shape (N,)), without any check."""
    return _candidates(corners, board, camera, used)[0]


def _inliers(
    pose: BoardPose, corners: np.ndarray, board: FlatBoard, camera: CameraIntrinsics
) -> np.ndarray:
    vector = cv2.Rodrigues(pose.rotation)[0]
    projected = _project(board.corner_points(), camera, vector, pose.translation)[0]
    errors = np.linalg.norm(projected - corners, axis=1)
    deviation = sigma_from_mad(float(np.nanmedian(errors)))
    return errors < max(_OUTLIER_PIXELS, _OUTLIER_DEVIATIONS * deviation)


def _check(candidates: list[BoardPose], max_reprojection: float) -> None:
    best = candidates[0]
    if not best.reprojection_rms <= max_reprojection:
        raise RefusedViewError(
            f"the corners miss the board by {best.reprojection_rms:.2f} px (root mean square), "
            f"{max_reprojection:g} px are allowed; is the image blurred or the board bent?"
        )
    for other in candidates[1:]:
        same = best.plane()[0] @ other.plane()[0] > _SAME_POSE_COSINE
        if not same and other.reprojection_rms < _AMBIGUOUS_RATIO * best.reprojection_rms:
            raise RefusedViewError(
                f"two different poses explain the corners alike ({best.reprojection_rms:.3f} and "
                f"{other.reprojection_rms:.3f} px); move the board nearer or tilt it more"
            )


def _candidates(
    corners: np.ndarray, board: FlatBoard, camera: CameraIntrinsics, used: np.ndarray
) -> list[BoardPose]:
    """Return the local optima of the reprojection error, the best first."""
    points, pixels = board.corner_points()[used], corners[used]
    matrix, distortion = camera_arrays(camera)
    _, vectors, translations, _ = cv2.solvePnPGeneric(
        points, pixels, matrix, distortion, flags=cv2.SOLVEPNP_IPPE
    )
    poses = []
    for start, start_translation in zip(vectors, translations, strict=True):
        vector, translation = cv2.solvePnPRefineLM(
            points, pixels, matrix, distortion, start, start_translation
        )
        poses.append(_pose(vector, translation, (points, pixels), camera, used))
    poses = [pose for pose in poses if np.isfinite(pose.reprojection_rms)]
    if not poses:
        raise RefusedViewError("no pose of the board explains the corners")
    return sorted(poses, key=lambda pose: pose.reprojection_rms)


def _pose(
    vector: np.ndarray,
    translation: np.ndarray,
    measured: tuple[np.ndarray, np.ndarray],
    camera: CameraIntrinsics,
    used: np.ndarray,
) -> BoardPose:
    points, pixels = measured
    rotation = cv2.Rodrigues(vector)[0]
    # With the board's centre as origin the translation is the position of the centre, and its block
    # of the covariance is that of the position of the plane.
    centre = points.mean(axis=0)
    centre_translation = rotation @ centre + translation[:, 0]
    projected, jacobian = _project(points - centre, camera, vector, centre_translation)
    errors = projected - pixels
    variance = (errors**2).sum() / max(2 * len(points) - 6, 1)
    covariance = variance * np.linalg.pinv(jacobian.T @ jacobian)[3:, 3:]
    normal = rotation[:, 2]
    return BoardPose(
        rotation=rotation,
        translation=translation[:, 0],
        used=used,
        reprojection_rms=float(np.sqrt((errors**2).sum(axis=1).mean())),
        plane_deviation=float(np.sqrt(normal @ covariance @ normal)),
    )


def _project(
    points: np.ndarray, camera: CameraIntrinsics, vector: np.ndarray, translation: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return pixels (N, 2) and their derivatives by rotation vector and translation (2N, 6)."""
    matrix, distortion = camera_arrays(camera)
    pixels, jacobian = cv2.projectPoints(points, vector, translation, matrix, distortion)
    return pixels[:, 0], jacobian[:, :6]
