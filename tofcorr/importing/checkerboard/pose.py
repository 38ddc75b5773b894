"""The camera intrinsics and the pose of a board from its corners, by OpenCV."""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from tofcorr.errors import CalibrationDataError
from tofcorr.estimation.robust import LEVEL, f_tail, sigma_from_mad
from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.importing.checkerboard.boards import FlatBoard
from tofcorr.importing.run import RefusedViewError

_SMALLEST_OUTLIER_PIXELS = 0.4
"""A corner is an outlier (glare, or a confusion with its neighbour) if its reprojection error
exceeds so many pixels and several standard deviations. Set by hand."""

_SMALLEST_SHARE_OF_CORNERS = 0.8
"""Smallest share of a view's corners that must fit: one pose, or one camera. Set by hand."""

_FEWEST_VIEWS = 5
"""Set by hand: two tilted views determine the camera, five allow outliers."""

_SMALLEST_TILT_DEG = 5.0
"""Parallel boards fit any focal length. The solver's standard deviations do not show it, because it
stops somewhere along a valley; so the root mean square tilt of the boards must be so large, and
focal length and deviation be sane. Set by hand."""


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

    def distance(self, rays: np.ndarray) -> np.ndarray:
        """Return the distance along rays of shape (..., 3) at which they meet the plane, metres."""
        normal, offset = self.plane()
        return -offset / (rays @ normal)

    def area(self, board: FlatBoard, rays: np.ndarray, margin: float) -> np.ndarray:
        """Return True where the viewing ray meets the board, shape (H, W).

        Args:
            board: The board.
            rays: Unit viewing rays, shape (H, W, 3).
            margin: How far the area extends beyond the outermost points, in squares. At 0 the
                corners surround all pixels; 1 is the outer edge of the squares; negative values
                shrink the area.
        """
        with np.errstate(divide="ignore", invalid="ignore"):  # Of rays along the plane.
            distance = self.distance(rays)
            on_plane = distance[..., None] * rays - self.translation
            in_squares = on_plane @ self.rotation[:, :2] / board.square_length
        places = board.corner_points()[:, :2] / board.square_length
        low, high = places.min(axis=0), places.max(axis=0)
        beyond = np.maximum(low - in_squares, in_squares - high)
        return (distance > 0) & (beyond.max(axis=-1) <= margin)


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
    points = board.corner_points()
    best, *others = poses_of(corners, board, camera, used)
    for _ in range(10):
        vector = cv2.Rodrigues(best.rotation)[0]
        projected = _project(points, camera, vector, best.translation)[0]
        errors = np.linalg.norm(projected - corners, axis=1)
        deviation = sigma_from_mad(float(np.nanmedian(errors)))
        inliers = errors < max(_SMALLEST_OUTLIER_PIXELS, 4 * deviation)
        if np.array_equal(inliers, used):
            break
        if inliers.sum() < _SMALLEST_SHARE_OF_CORNERS * seen.sum():
            raise RefusedViewError(f"only {inliers.sum()} of {seen.sum()} corners fit one pose")
        used = inliers
        best, *others = poses_of(corners, board, camera, used)
    if not best.reprojection_rms <= max_reprojection:
        missed = f"{best.reprojection_rms:.2f} px of at most {max_reprojection:g} px"
        raise RefusedViewError(f"the corners miss the board by {missed}; is it bent, or blurred?")
    unknown = 2 * int(used.sum()) - 6
    for other in others:
        # Poses whose normals differ by less than 3 degrees are the same pose. Of a board that is
        # small or far, the errors of two others do not differ significantly.
        same = best.plane()[0] @ other.plane()[0] > np.cos(np.radians(3))
        ratio = np.square(np.float64(other.reprojection_rms) / best.reprojection_rms)
        if not same and f_tail(float(ratio), unknown, unknown) > LEVEL:
            raise RefusedViewError("two different poses fit; move the board nearer or tilt it more")
    return best


def poses_of(
    corners: np.ndarray, board: FlatBoard, camera: CameraIntrinsics, used: np.ndarray
) -> list[BoardPose]:
    """Return the local optima of the reprojection error of the corners `used`, the best first."""
    points, pixels = board.corner_points()[used], corners[used]
    matrix, distortion = np.array(camera.matrix), np.array(camera.distortion, dtype=np.float64)
    _, vectors, translations, _ = cv2.solvePnPGeneric(
        points, pixels, matrix, distortion, flags=cv2.SOLVEPNP_IPPE
    )
    # With the board's centre as origin the translation is the position of the centre, and its block
    # of the covariance is that of the position of the plane.
    centre, poses = points.mean(axis=0), []
    for start in zip(vectors, translations, strict=True):
        vector, translation = cv2.solvePnPRefineLM(points, pixels, matrix, distortion, *start)
        rotation, place = cv2.Rodrigues(vector)[0], translation[:, 0]
        projected, jacobian = _project(points - centre, camera, vector, rotation @ centre + place)
        errors = projected - pixels
        variance = (errors**2).sum() / max(2 * len(points) - 6, 1)
        covariance = variance * np.linalg.pinv(jacobian.T @ jacobian)[3:, 3:]
        pose = BoardPose(
            rotation=rotation,
            translation=place,
            used=used,
            reprojection_rms=float(np.sqrt((errors**2).sum(axis=1).mean())),
            plane_deviation=float(np.sqrt(rotation[:, 2] @ covariance @ rotation[:, 2])),
        )
        if np.isfinite(pose.reprojection_rms):
            poses.append(pose)
    if not poses:
        raise RefusedViewError("no pose of the board explains the corners")
    return sorted(poses, key=lambda pose: pose.reprojection_rms)


def _project(
    points: np.ndarray, camera: CameraIntrinsics, vector: np.ndarray, translation: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return pixels (N, 2) and their derivatives by rotation vector and translation (2N, 6)."""
    matrix, distortion = np.array(camera.matrix), np.array(camera.distortion, dtype=np.float64)
    pixels, jacobian = cv2.projectPoints(points, vector, translation, matrix, distortion)
    return pixels[:, 0], jacobian[:, :6]


def calibrate(
    corner_sets: list[np.ndarray], board: FlatBoard, size: tuple[int, int]
) -> tuple[CameraIntrinsics, dict[str, Any]]:
    """Calibrate focal lengths, principal point and distortion; leave out outlying corners.

    Args:
        corner_sets: Corners of each view in the order of `FlatBoard.corner_points`, shapes (N, 2);
            NaN for corners that are hidden.
        board: The board.
        size: Width and height of the images.

    Returns:
        The intrinsics, with distortion k1 k2 p1 p2 k3; and what `import.json` says of them: the
        root mean square reprojection error of the corners used, pixels, standard deviations of fx,
        fy, cx, cy (pixels), k1, k2, p1, p2, k3, and the numbers of views and of corners left out.

    Raises:
        CalibrationDataError: There are too few views, or they do not determine the camera.
    """
    views = len(corner_sets)
    if views < _FEWEST_VIEWS:
        raise CalibrationDataError(f"{views} views show the board; at least {_FEWEST_VIEWS} must.")
    chosen = [np.asarray(np.isfinite(corners).all(axis=1)) for corners in corner_sets]
    most = 5
    while True:
        camera, about, errors = _solve(corner_sets, chosen, board, size)
        # Five standard deviations of a coordinate: the median length of an error is 1.18.
        deviation = float(np.nanmedian(np.concatenate(errors))) / np.sqrt(2 * np.log(2))
        limit = max(_SMALLEST_OUTLIER_PIXELS, 5 * deviation)
        # An outlier shifts its whole view, so the best corners of each view are always kept.
        inliers = [
            error <= max(limit, np.nanquantile(error, _SMALLEST_SHARE_OF_CORNERS))
            for error in errors
        ]
        if most == 0 or all(map(np.array_equal, inliers, chosen)):
            break
        chosen, most = inliers, most - 1
    keep = [
        i
        for i, error in enumerate(errors)
        if (error[np.isfinite(error)] <= limit).mean() >= _SMALLEST_SHARE_OF_CORNERS
    ]
    if len(keep) == len(corner_sets):
        return camera, about
    if len(keep) < _FEWEST_VIEWS:
        raise CalibrationDataError(f"only {len(keep)} views fit one camera. Is the board flat?")
    return _solve([corner_sets[i] for i in keep], [chosen[i] for i in keep], board, size)[:2]


def calibration_warning(camera: CameraIntrinsics, about: dict[str, Any]) -> str:
    """Return a sentence on how the uncertainty of the focal length affects distances."""
    focal_length, deviation = camera.matrix[0][0], about["standard_deviations"][0]
    slope = 1000 * deviation / focal_length
    found = f"The focal length of {about['views']} views is {focal_length:.1f} ± {deviation:.1f} px"
    return f"{found}: the distance error's slope is uncertain by {slope:.1f} mm/m."


def _solve(
    corner_sets: list[np.ndarray], used: list[np.ndarray], board: FlatBoard, size: tuple[int, int]
) -> tuple[CameraIntrinsics, dict[str, Any], list[np.ndarray]]:
    points = board.corner_points()
    pixels = [c[u].astype(np.float32) for c, u in zip(corner_sets, used, strict=True)]
    try:
        rms, matrix, distortion, rotations, translations, deviations, _, _ = (
            cv2.calibrateCameraExtended(
                [points[u].astype(np.float32) for u in used], pixels, size, np.eye(3), np.zeros(5)
            )
        )
    except cv2.error as error:
        raise CalibrationDataError(f"OpenCV cannot calibrate the camera: {error.err}.") from None
    distortion = distortion.ravel()[:5]
    deviations = deviations.ravel()[:9]
    # Refused are focal lengths that are uncertain by a fifth, or unlike any camera's.
    focal_lengths = matrix[[0, 1], [0, 1]]
    sound = np.isfinite(matrix).all() and np.isfinite(deviations).all()
    sane = (5 * focal_lengths > max(size)) & (focal_lengths < 20 * max(size))
    sane &= 5 * deviations[:2] < focal_lengths
    # The root mean square angle between the boards' normals and their mean.
    normals = np.stack([cv2.Rodrigues(rotation)[0][:, 2] for rotation in rotations])
    mean = normals.mean(axis=0)
    cosines = np.clip(normals @ mean / np.linalg.norm(mean), -1.0, 1.0)
    tilt = float(np.degrees(np.sqrt(np.mean(np.arccos(cosines) ** 2))))
    if not (sound and sane.all()) or tilt < _SMALLEST_TILT_DEG:
        said = f"the board's tilts vary by {tilt:.1f} degrees ({_SMALLEST_TILT_DEG:g} needed)"
        raise CalibrationDataError(f"{said}; tilt it about both axes, or give the intrinsics.")
    errors = [
        np.linalg.norm(
            cv2.projectPoints(points, turn, move, matrix, distortion)[0][:, 0] - own, axis=1
        )
        for own, turn, move in zip(corner_sets, rotations, translations, strict=True)
    ]
    camera = CameraIntrinsics(
        width=size[0],
        height=size[1],
        matrix=tuple(map(tuple, matrix.tolist())),  # type: ignore[arg-type]
        distortion=tuple(distortion.tolist()),
    )
    seen = sum(int(np.isfinite(corners).all(axis=1).sum()) for corners in corner_sets)
    about = {
        "reprojection_rms_px": float(rms),
        "standard_deviations": deviations.tolist(),
        "views": len(used),
        "outlying_corners": seen - sum(int(u.sum()) for u in used),
    }
    return camera, about, errors
