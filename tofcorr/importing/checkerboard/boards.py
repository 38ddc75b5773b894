"""Flat boards of several kinds: how their points are found, and what they say of camera and pose.

Active illumination falls with the square of the distance, so that counts span decades: every kind
of board is searched in several renderings of an image, and its points are refined on the counts.
OpenCV estimates the camera intrinsics and the pose of the board from them.
"""

import re
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import compress
from typing import Annotated, Any, ClassVar, Literal, Self

import cv2
import numpy as np
from pydantic import Field

from tofcorr.errors import CalibrationDataError, ConfigError
from tofcorr.estimation.robust import LEVEL, f_tail, sigma_from_mad
from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.importing.run import RefusedViewError
from tofcorr.options import Options, PositiveNumber

_FEWEST_CORNERS = 8
"""Fewer points of a board (no unit) do not place it: two tags, or a fifth of a small ChArUco board.
Set by hand."""

_SMALL_IMAGE_PIXELS = 1_000_000
"""Largest number of pixels of an image that is enlarged before the search: adaptive thresholds need
several pixels per square. Set by hand."""

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


class FlatBoard(Options, ABC):
    """A flat board with points that can be found in an image.

    Attributes:
        kind: What the recording calls the target.
        columns: Inner corners, squares or tags in a row, as the kind counts them.
        rows: The same in a column.
        square_length: Side of a square or tag, metres: all points scale with it.
        dictionary: Of the markers, such as `4X4_50`; empty: the kind's usual one.
        share: Side of a marker (ChArUco) or space between tags (AprilTags) as a share of the side
            of a square or tag; 0: the kind's usual one.
    """

    called: ClassVar[str] = "{size}"
    """What messages call the board."""
    usual: ClassVar[tuple[str, float]] = ("", 0.0)
    """Dictionary and share of markers where none are given."""
    kind: Any
    columns: Annotated[int, Field(ge=3)]
    rows: Annotated[int, Field(ge=3)]
    square_length: PositiveNumber
    dictionary: str = ""
    share: Annotated[float, Field(gt=0.0, lt=1.0)] = 0.0

    @abstractmethod
    def corner_points(self) -> np.ndarray:
        """Return the points in the board's frame, shape (N, 3), metres, in the plane z = 0."""

    @abstractmethod
    def find(self, image: np.ndarray) -> np.ndarray | None:
        """Find the points in an image (H, W) of any number type.

        Returns:
            Pixel coordinates (u, v), shape (N, 2), NaN for points that are hidden; None if the
            board is not seen.
        """

    def fewer(self) -> Self | None:
        """Return the board that a user means who counted squares instead of corners.

        None: the kind is described by its squares or tags.
        """
        return None

    def __str__(self) -> str:
        """Name the board."""
        size = f"{self.columns}x{self.rows}"
        return self.called.format(size=size, dictionary=self.dictionary or self.usual[0])

    def markers(self) -> tuple[cv2.aruco.Dictionary, float]:
        """Return the dictionary of the markers, and their share.

        Raises:
            ConfigError: There is no such dictionary.
        """
        known = {key.upper(): key for key in dir(cv2.aruco) if key.startswith("DICT_")}
        name = self.dictionary or self.usual[0]
        wanted = f"DICT_{name.upper().removeprefix('DICT_')}"
        if wanted not in known:
            listed = ", ".join(sorted(key.removeprefix("DICT_") for key in known))
            raise ConfigError(f"There is no dictionary of markers '{name}'. Known: {listed}.")
        found = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, known[wanted]))
        return found, self.square_length * (self.share or self.usual[1])


class Board(FlatBoard):
    """A checkerboard, described as OpenCV does: inner corners (where four squares meet)."""

    kind: Literal["checkerboard"] = "checkerboard"

    def corner_points(self) -> np.ndarray:
        """Return the inner corners in the board's frame, row by row, shape (N, 3), metres.

        The first corner is the origin, x runs along a row, and the board is the plane z = 0.
        """
        row, column = np.divmod(np.arange(self.rows * self.columns), self.columns)
        return np.stack([column, row, np.zeros_like(row)], axis=1) * self.square_length

    def find(self, image: np.ndarray) -> np.ndarray | None:
        """Find the corners in an image; all of them or none.

        OpenCV's classic detector comes first, then its slower sector-based one. The order is that
        of `corner_points` up to a symmetry of the board, which changes neither plane nor outline.
        """
        size = (self.columns, self.rows)
        classic = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
        classic |= cv2.CALIB_CB_FAST_CHECK
        for search, flags in (
            (cv2.findChessboardCorners, classic),
            (cv2.findChessboardCornersSB, cv2.CALIB_CB_NORMALIZE_IMAGE),
        ):
            for rendering, scale in _renderings(image):
                found, corners = search(rendering, size, flags=flags)
                if found:
                    return self._refined(image, _unscaled(corners, scale))
        return None

    def fewer(self) -> Self | None:
        """Return the board of one row and column fewer; OpenCV refuses fewer than 3 corners."""
        if min(self.columns, self.rows) <= 3:
            return None
        return self.model_copy(update={"columns": self.columns - 1, "rows": self.rows - 1})

    def _refined(self, image: np.ndarray, corners: np.ndarray) -> np.ndarray:
        """Refine corners on the logarithm of the counts around the board.

        With the logarithm an edge between dark and bright squares looks the same near and far.
        """
        grid = corners.reshape(self.rows, self.columns, 2)
        steps = [np.linalg.norm(np.diff(grid, axis=axis), axis=-1).min() for axis in (0, 1)]
        spacing = float(min(steps))
        low = np.maximum(np.floor(corners.min(axis=0) - spacing), 0).astype(int)
        high = np.ceil(corners.max(axis=0) + spacing).astype(int) + 1
        patch = np.log1p(image[low[1] : high[1], low[0] : high[0]].astype(np.float32))
        # The window must not contain the next corner. Set on 102 real views: 0.4 had the smallest
        # reprojection error and lost no corner.
        return _to_subpixels(patch, corners - low, 2 * spacing / 5) + low


class CharucoBoard(FlatBoard):
    """A ChArUco board: a checkerboard whose white squares carry markers, found even in part."""

    kind: Literal["charuco"] = "charuco"
    called = "ChArUco {size} ({dictionary})"
    usual = ("4X4_50", 0.75)

    def corner_points(self) -> np.ndarray:
        """Return the inner corners, row by row, shape (N, 3), metres."""
        return np.asarray(self._board().getChessboardCorners(), dtype=np.float64)

    def find(self, image: np.ndarray) -> np.ndarray | None:
        """Find the corners in an image; in the rendering that shows most of them."""
        detector = cv2.aruco.CharucoDetector(self._board())
        best = np.full(((self.columns - 1) * (self.rows - 1), 2), np.nan)
        most = _FEWEST_CORNERS - 1
        for rendering, scale in _renderings(image):
            corners, numbers, _, _ = detector.detectBoard(rendering)
            if numbers is not None and len(numbers) > most:
                most, best[:] = len(numbers), np.nan
                best[np.ravel(numbers).astype(int)] = _unscaled(corners, scale)
            if most == len(best):
                break
        return best if most >= _FEWEST_CORNERS else None

    def _board(self) -> cv2.aruco.CharucoBoard:
        dictionary, side = self.markers()
        size = (self.columns, self.rows)
        return cv2.aruco.CharucoBoard(size, self.square_length, side, dictionary)


class AprilGrid(FlatBoard):
    """A grid of AprilTags, numbered row by row from zero, found even in part.

    The side of a tag is its black border's.
    """

    kind: Literal["apriltag"] = "apriltag"
    called = "{size} tags ({dictionary})"
    usual = ("APRILTAG_36H11", 0.3)

    def corner_points(self) -> np.ndarray:
        """Return the corners of the tags, tag by tag, shape (N, 3), metres."""
        dictionary, space = self.markers()
        size = (self.columns, self.rows)
        grid = cv2.aruco.GridBoard(size, self.square_length, space, dictionary)
        return np.concatenate(grid.getObjPoints()).astype(np.float64)

    def find(self, image: np.ndarray) -> np.ndarray | None:
        """Find the tags in all renderings of an image, and refine their corners on its counts."""
        detector = cv2.aruco.ArucoDetector(self.markers()[0])
        found = np.full((self.columns * self.rows, 4, 2), np.nan)
        for rendering, scale in _renderings(image):
            corners, numbers, _ = detector.detectMarkers(rendering)
            tags = () if numbers is None else np.ravel(numbers).astype(int).tolist()
            for four, number in zip(corners, tags, strict=True):
                if number < len(found) and np.isnan(found[number]).any():
                    found[number] = _unscaled(four, scale)
            if np.isfinite(found).all():
                break
        seen = np.isfinite(found).all(axis=(1, 2))
        if 4 * seen.sum() < _FEWEST_CORNERS:
            return None
        tags = found[seen]
        sides = np.linalg.norm(tags - np.roll(tags, 1, axis=1), axis=2)
        # On counts: their logarithm would shrink dark tags. A bit of a tag measures an eighth of
        # its side, and the window must not contain the next edge.
        refined = _to_subpixels(image.astype(np.float32), tags.reshape(-1, 2), sides.min() / 10)
        found[seen] = refined.reshape(tags.shape)
        return found.reshape(-1, 2)


AnyBoard = Annotated[Board | CharucoBoard | AprilGrid, Field(discriminator="kind")]
"""A board of a kind that is known."""


def read_board(text: str) -> dict[str, str]:
    """Read `5x7`, `charuco:5x7:4X4_50:0.75` or `apriltag:6x6:APRILTAG_36H11:0.3`.

    That is `KIND:COLUMNSxROWS:DICTIONARY:SHARE`, of which the last two may be missing, or
    `COLUMNSxROWS` of a checkerboard.

    Returns:
        The fields of a board that the text gives.

    Raises:
        ConfigError: The text is something else.
    """
    kind, number, word = "(?:(checkerboard|charuco|apriltag):)?", r"(\d+)", "(?::([^:]+))?"
    match = re.fullmatch(f"{kind}{number}[xX]{number}{word}{word}", text)
    if match is None or (match[1] in (None, "checkerboard") and match[4] is not None):
        raise ConfigError(f"expected 5x7, charuco:5x7:4X4_50:0.75 or the like, got '{text[:60]}'.")
    keys = ("kind", "columns", "rows", "dictionary", "share")
    given = zip(keys, (match[1] or "checkerboard", *match.groups()[1:]), strict=True)
    return {key: value for key, value in given if value is not None}


def _renderings(infrared: np.ndarray) -> Iterator[tuple[np.ndarray, int]]:
    """Yield 8-bit images with their enlargement, the most promising first."""
    counts = infrared.astype(np.float32)
    logarithmic = _eight_bit(np.log1p(counts), 99.9)
    contrasts = (
        cv2.createCLAHE(clipLimit=3.0, tileGridSize=(8, 8)).apply(logarithmic),
        _eight_bit(counts, 99),
        logarithmic,
    )
    for scale in (2, 1) if infrared.size <= _SMALL_IMAGE_PIXELS else (1, 2):
        for contrast in contrasts:
            yield _enlarged(contrast, scale), scale


def _eight_bit(values: np.ndarray, high_percentile: float) -> np.ndarray:
    low, high = np.percentile(values, [1, high_percentile])
    stretched = (values - low) * (255 / max(high - low, np.finfo(np.float32).eps))
    return np.clip(stretched, 0, 255).astype(np.uint8)


def _enlarged(image: np.ndarray, scale: int) -> np.ndarray:
    return cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)


def _to_subpixels(image: np.ndarray, corners: np.ndarray, half_window: float) -> np.ndarray:
    """Refine corners (N, 2) on an image of floats, within a window (half its side, pixels)."""
    window, scale = 2 * (max(2, round(2 * half_window)),), 2
    # Pixel centres are at integers, so enlarging shifts the origin by half a pixel.
    there = ((corners + 0.5) * scale - 0.5).astype(np.float32)
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 100, 1e-4)
    larger = _enlarged(image, scale)
    refined = cv2.cornerSubPix(larger, np.ascontiguousarray(there), window, (-1, -1), stop)
    return _unscaled(refined, scale)


def _unscaled(pixels: np.ndarray, scale: int) -> np.ndarray:
    """Return pixels (N, 2) of an enlarged image as pixels of the image itself."""
    return (pixels.reshape(-1, 2).astype(np.float64) + 0.5) / scale - 0.5


@dataclass(frozen=True, kw_only=True)
class BoardPose:
    """The board in the camera frame: x_camera = rotation x_board + translation.

    Attributes:
        rotation: Shape (3, 3).
        translation: Shape (3,), metres.
        used: Which corners are used for the pose, shape (N,), bool.
        reprojection_rms: Root mean square reprojection error of the corners used, pixels.
        plane_covariance: Of n and d, shape (4, 4), propagated from the reprojection errors. Errors
            that all views share (focal length, square length) are not included.
    """

    rotation: np.ndarray
    translation: np.ndarray
    used: np.ndarray
    reprojection_rms: float
    plane_covariance: np.ndarray

    def plane(self) -> tuple[np.ndarray, float]:
        """Return n (3,) and d in metres of n . x + d = 0 in the camera frame, n to the camera."""
        normal = self.rotation[:, 2]
        offset = -float(normal @ self.translation)
        return (normal, offset) if offset > 0 else (-normal, -offset)

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
        (rotation, by_vector), place = cv2.Rodrigues(vector), translation[:, 0]
        projected, jacobian = _project(points - centre, camera, vector, rotation @ centre + place)
        errors = projected - pixels
        variance = (errors**2).sum() / max(2 * len(points) - 6, 1)
        covariance = variance * np.linalg.pinv(jacobian.T @ jacobian)
        # Of n, the third column of the rotation, and of d = -n . centre.
        turned = by_vector.reshape(3, 3, 3)[:, :, 2].T
        of_offset = np.append(-(rotation @ centre + place) @ turned, -rotation[:, 2])
        slope = np.vstack([np.hstack([turned, np.zeros((3, 3))]), of_offset])
        pose = BoardPose(
            rotation=rotation,
            translation=place,
            used=used,
            reprojection_rms=float(np.sqrt((errors**2).sum(axis=1).mean())),
            plane_covariance=slope @ covariance @ slope.T,
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
    shares = [(error[np.isfinite(error)] <= limit).mean() for error in errors]
    fits = [share >= _SMALLEST_SHARE_OF_CORNERS for share in shares]
    if all(fits):
        return camera, about
    if sum(fits) < _FEWEST_VIEWS:
        raise CalibrationDataError(f"only {sum(fits)} views fit one camera. Is the board flat?")
    corners, used = (list(compress(every, fits)) for every in (corner_sets, chosen))
    return _solve(corners, used, board, size)[:2]


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
    camera = CameraIntrinsics(
        width=size[0],
        height=size[1],
        matrix=tuple(map(tuple, matrix.tolist())),  # type: ignore[arg-type]
        distortion=tuple(distortion.tolist()),
    )
    places = zip(corner_sets, rotations, translations, strict=True)
    errors = [
        np.linalg.norm(_project(points, camera, turn, move)[0] - own, axis=1)
        for own, turn, move in places
    ]
    seen = sum(int(np.isfinite(corners).all(axis=1).sum()) for corners in corner_sets)
    about = {
        "reprojection_rms_px": float(rms),
        "standard_deviations": deviations.tolist(),
        "views": len(used),
        "outlying_corners": seen - sum(int(u.sum()) for u in used),
    }
    return camera, about, errors
