"""Quantities that views of a board cannot separate: focal length, square length, error slope.

With a longer focal length the board is farther away, and its corners have almost the same pixels;
with longer squares exactly the same. Both look like a distance error proportional to the distance.
"""

from dataclasses import asdict, dataclass, replace

import numpy as np

from tofcorr.data.header import DepthKind
from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.importing.checkerboard.board import FlatBoard
from tofcorr.importing.checkerboard.pose import BoardPose, refit_pose

# Relative changes of focal length and square length that are tried. Set by hand: typical errors of
# factory intrinsics and of a printed board.
FOCAL_CHANGE = 0.02
SQUARE_CHANGE = 0.01
# Smallest range of distances for which a slope is given, metres. Set by hand.
_NARROWEST_RANGE = 0.1


@dataclass(frozen=True, kw_only=True)
class Alternative:
    """Results for another focal length or square length.

    Attributes:
        focal_factor: Multiplies the focal lengths.
        square_factor: Multiplies the square length.
        reprojection_rms_px: Root mean square over the views, corners used only.
        slope_mm_per_m: Slope of the views' median depth error over distance; None if the range of
            distances is too small.
        mean_error_mm: Mean of the views' median depth errors.
    """

    focal_factor: float
    square_factor: float
    reprojection_rms_px: float
    slope_mm_per_m: float | None
    mean_error_mm: float


@dataclass(frozen=True, kw_only=True)
class PosedView:
    """One view: its corners, its board's pose, and the median depth error (metres)."""

    corners: np.ndarray
    pose: BoardPose
    depth_error: float


@dataclass(frozen=True, kw_only=True)
class Degeneracy:
    """The result as given, and alternatives that the corners cannot exclude."""

    as_given: Alternative
    alternatives: list[Alternative]

    def to_mapping(self) -> dict[str, object]:
        """Return plain values for JSON."""
        return asdict(self)

    def warning(self) -> str:
        """Return the result as a sentence with numbers."""
        given = self.as_given
        shorter, longer, larger = self.alternatives
        text = (
            "A board cannot tell focal length, square length and slope of the distance error "
            f"apart: with the focal length {FOCAL_CHANGE:.0%} shorter or longer the reprojection "
            f"error is {shorter.reprojection_rms_px:.3f} or {longer.reprojection_rms_px:.3f} px "
            f"instead of {given.reprojection_rms_px:.3f} px"
        )
        if given.slope_mm_per_m is not None:
            text += (
                f", yet the slope of the depth error is {shorter.slope_mm_per_m:+.1f} or "
                f"{longer.slope_mm_per_m:+.1f} instead of {given.slope_mm_per_m:+.1f} mm/m"
            )
        text += (
            f", and its mean {shorter.mean_error_mm:+.1f} or {longer.mean_error_mm:+.1f} instead "
            f"of {given.mean_error_mm:+.1f} mm; squares {SQUARE_CHANGE:.0%} larger leave the "
            "reprojection error as it is and make "
        )
        if larger.slope_mm_per_m is not None:
            text += f"the slope {larger.slope_mm_per_m:+.1f} mm/m, "
        return text + (
            f"the mean {larger.mean_error_mm:+.1f} mm. Measure the printed board, and take the "
            "focal length from a source of its own, before trusting offset and slope."
        )


def study_degeneracy(
    views: list[PosedView], board: FlatBoard, camera: CameraIntrinsics, depth_kind: DepthKind
) -> Degeneracy:
    """Estimate the poses again with other focal lengths and square lengths.

    Args:
        views: The views of the recording.
        board: The board as given.
        camera: The camera intrinsics used.
        depth_kind: Kind of the views' depth errors.
    """
    changes = ((1.0 - FOCAL_CHANGE, 1.0), (1.0 + FOCAL_CHANGE, 1.0), (1.0, 1.0 + SQUARE_CHANGE))
    return Degeneracy(
        as_given=_read_with(views, board, camera, depth_kind, (1.0, 1.0)),
        alternatives=[_read_with(views, board, camera, depth_kind, change) for change in changes],
    )


def _read_with(
    views: list[PosedView],
    board: FlatBoard,
    camera: CameraIntrinsics,
    depth_kind: DepthKind,
    factors: tuple[float, float],
) -> Alternative:
    focal_factor, square_factor = factors
    other_camera = replace(camera, matrix=_with_focal_length(camera, focal_factor))
    other_board = board.scaled(square_factor)
    errors, distances, squares = [], [], []
    for view in views:
        pose = refit_pose(view.corners, other_board, other_camera, view.pose.used)
        distance = _distance(pose, other_board, depth_kind)
        errors.append(view.depth_error + _distance(view.pose, board, depth_kind) - distance)
        distances.append(distance)
        squares.append(pose.reprojection_rms**2)
    return Alternative(
        focal_factor=focal_factor,
        square_factor=square_factor,
        reprojection_rms_px=float(np.sqrt(np.mean(squares))),
        slope_mm_per_m=_slope(np.array(distances), 1e3 * np.array(errors)),
        mean_error_mm=1e3 * float(np.mean(errors)),
    )


def _distance(pose: BoardPose, board: FlatBoard, depth_kind: DepthKind) -> float:
    centre = pose.centre(board)
    return float(centre[2] if depth_kind == "z" else np.linalg.norm(centre))


def _slope(distances: np.ndarray, errors: np.ndarray) -> float | None:
    if np.ptp(distances) < _NARROWEST_RANGE:
        return None
    return float(np.polyfit(distances, errors, 1)[0])


def _with_focal_length(camera: CameraIntrinsics, factor: float) -> tuple:
    (fx, skew, cx), (_, fy, cy), last = camera.matrix
    return ((fx * factor, skew, cx), (0.0, fy * factor, cy), last)
