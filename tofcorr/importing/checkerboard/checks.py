"""What a board says of measured depth: wrong units, mixed-up images, and what it cannot tell apart.

Only gross disagreement is refused (a tenth of the distance, tens of degrees). Errors of millimetres
and centimetres are what the recording is made for; they are kept. All limits were set by hand, far
beyond the errors of a working camera; on the 102 views of the Kinect v2 in
`tests/importing/checkerboard/test_kinect2.py` they refuse at most 4.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from tofcorr.data.recording import DepthKind
from tofcorr.errors import CalibrationDataError
from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.importing.checkerboard.boards import FlatBoard
from tofcorr.importing.checkerboard.pose import BoardPose, poses_of
from tofcorr.importing.run import RefusedViewError

_FEWEST_PIXELS = 50
"""Fewest board pixels with depth; a fifth of all board pixels must have it, too."""

_LARGEST_TILT_DEG = 25.0
"""Largest angle between the plane of the depth image and the board's pose, degrees: boards taken
for one another, or mirrored, differ by more."""

_TENTH = 0.1
"""Share of the distance: 0.1 m at 1 m is beyond any camera's error, and mixed-up images exceed it.
From half of it on all views together get a warning: 5 cm at 1 m is the largest error that an
uncalibrated camera is known for."""

_CHANGES = {"focal": 0.02, "square": 0.01}
"""Relative changes of focal length and square length that are tried: typical errors of factory
intrinsics and of a printed board."""


@dataclass(frozen=True, kw_only=True)
class BoardView:
    """A view whose board has a pose: measured depth against it.

    Attributes:
        name: What the view is called.
        pose: The board in the camera frame.
        board_pixels: Pixels that see the board.
        usable_pixels: Those with depth and below saturation.
        distance: Median true radial distance, metres.
        error: Median of measured minus true depth, of the kind recorded, metres.
        ratio: Median of measured over true distance.
        kind_moments: Sum over pixels of v v', shape (4, 4), metres, with v = (1, D, D (1 - cos a),
            measured minus true radial distance) and a the angle to the optical axis.
    """

    name: str
    pose: BoardPose
    board_pixels: int
    usable_pixels: int
    distance: float
    error: float
    ratio: float
    kind_moments: np.ndarray


def compare_depth(
    name: str,
    pose: BoardPose,
    depth: np.ndarray,
    usable: np.ndarray,
    area: np.ndarray,
    rays: np.ndarray,
    depth_kind: DepthKind,
) -> BoardView:
    """Compare one depth image with the board's pose.

    Args:
        name: What the view is called.
        pose: Pose of the board.
        depth: Shape (H, W), metres, of `depth_kind`.
        usable: Which depth values may be used, shape (H, W), bool.
        area: Which pixels see the board, shape (H, W), bool.
        rays: Shape (H, W, 3).
        depth_kind: `radial` or `z`.

    Raises:
        RefusedViewError: Too few pixels have depth, or the depth has another tilt.
    """
    seen = area & usable
    if seen.sum() < max(_FEWEST_PIXELS, area.sum() / 5):
        raise RefusedViewError(
            f"only {seen.sum()} of {area.sum()} board pixels have depth below saturation; "
            f"{_FEWEST_PIXELS} and {1 / 5:.0%} are needed"
        )
    rays = rays[seen]
    cosine = rays[:, 2]
    true = pose.distance(rays)
    along = cosine if depth_kind == "z" else 1.0
    measured = depth[seen] / along
    errors = measured - true
    # Flying pixels would tilt the plane of the depth.
    near = (measured[:, None] * rays)[np.abs(errors - np.median(errors)) < _TENTH / 2]
    # Noisy depth has no tilt; `refuse_mixed_up` still checks the ratio.
    if len(near) >= _FEWEST_PIXELS:
        normal = np.linalg.svd(near - near.mean(axis=0), full_matrices=False)[2][2]
        tilt = float(np.degrees(np.arccos(min(abs(float(normal @ pose.plane()[0])), 1.0))))
        if tilt > _LARGEST_TILT_DEG:
            raise RefusedViewError(
                f"the depth image shows a plane tilted by {tilt:.0f} degrees against the board's "
                "pose; are the two images of the same view?"
            )
    columns = np.stack([np.ones_like(true), true, true * (1.0 - cosine), errors])
    return BoardView(
        name=name,
        pose=pose,
        board_pixels=int(area.sum()),
        usable_pixels=int(seen.sum()),
        distance=float(np.median(true)),
        error=float(np.median(errors * along)),
        ratio=float(np.median(measured / true)),
        kind_moments=columns @ columns.T,
    )


def typical_ratio(views: Sequence[BoardView]) -> float:
    """Return the median ratio of measured to true distance.

    Raises:
        CalibrationDataError: It is so far from 1 that a unit must be wrong: units differ by factors
            of 10 and more, cameras by a tenth.
    """
    ratio = float(np.median([view.ratio for view in views]))
    if not 0.5 < ratio < 2:
        raise CalibrationDataError(
            f"the depth images read {ratio:.3g} times the distance at which the corners place the "
            "board; correct the unit of depth (millimetres per count) or the square length."
        )
    return ratio


def refuse_mixed_up(view: BoardView, ratio: float) -> BoardView:
    """Return a view, unless its ratio of measured to true distance differs much from that of all.

    Raises:
        RefusedViewError: Depth and infrared image are not of the same view, or the pose is wrong.
    """
    if abs(view.ratio / ratio - 1.0) > _TENTH:
        raise RefusedViewError(
            f"the depth image reads {view.ratio * view.distance:.3f} m where the board "
            f"stands at {view.distance:.3f} m, other views {ratio:.3f} times the distance; "
            "are the two images of the same view?"
        )
    return view


def agreement_warnings(
    views: Sequence[BoardView], ratio: float, depth_kind: DepthKind
) -> list[str]:
    """Return warnings about the unit and the kind of depth.

    The radial error is regressed on D (1 - cosine), with a constant and D as further regressors:
    radial depth declared as z gives a slope of +1, z depth declared as radial gives -1.
    """
    warnings = []
    if abs(ratio - 1.0) > _TENTH / 2:
        warnings.append(
            f"Depth reads {100 * (ratio - 1):+.1f} % against the board: check the square length, "
            "the focal length and the unit of depth before calling it a distance error."
        )
    moments = np.sum([view.kind_moments for view in views], axis=0)
    # After removing constant and D, D (1 - cosine) must vary by more than the camera's own error,
    # some millimetres, to estimate its slope.
    explained = moments[2, :2] @ np.linalg.pinv(moments[:2, :2]) @ moments[:2, 2]
    spread_mm = 1000 * np.sqrt(max(moments[2, 2] - explained, 0.0) / moments[0, 0])
    if spread_mm < 5:
        return warnings
    slope = float(np.linalg.solve(moments[:3, :3], moments[:3, 3])[2])
    if abs(slope) > 0.5:
        warnings.append(
            f"Away from the image centre the depth error grows with {slope:+.2f} of what turns "
            f"z into radial depth (0 expected, {'+1' if depth_kind == 'z' else '-1'} if the kind "
            f"is wrong): is depth really '{depth_kind}'?"
        )
    return warnings


def study_degeneracy(
    views: Sequence[tuple[np.ndarray, BoardPose, float]],
    board: FlatBoard,
    camera: CameraIntrinsics,
    depth_kind: DepthKind,
) -> dict[str, Any]:
    """Estimate the poses again with other focal lengths and square lengths.

    With a longer focal length the board is farther away, and its corners have almost the same
    pixels; with longer squares exactly the same. Both look like a distance error proportional to
    the distance.

    Args:
        views: Of each view the corners, the board's pose, and the median depth error, metres.
        board: The board as given.
        camera: The camera intrinsics used.
        depth_kind: Kind of the views' depth errors.

    Returns:
        What `import.json` says of it: `as_given`, and `alternatives` that the corners cannot
        exclude (shorter and longer focal length, larger squares).
    """

    def read_with(focal: float, square: float) -> dict[str, Any]:
        (fx, skew, cx), (_, fy, cy), last = camera.matrix
        other = replace(camera, matrix=((fx * focal, skew, cx), (0.0, fy * focal, cy), last))
        larger = replace(board, square_length=board.square_length * square)
        poses = [poses_of(corners, larger, other, pose.used)[0] for corners, pose, _ in views]
        distances = np.array([distance(pose, larger) for pose in poses])
        errors = np.array([error + distance(pose, board) for _, pose, error in views]) - distances
        # Over less than 0.1 m a slope says nothing.
        slope = None if np.ptp(distances) < _TENTH else np.polyfit(distances, 1000 * errors, 1)[0]
        return {
            "focal_factor": focal,
            "square_factor": square,
            "reprojection_rms_px": float(np.sqrt(np.mean([p.reprojection_rms**2 for p in poses]))),
            "slope_mm_per_m": None if slope is None else float(slope),
            "mean_error_mm": 1000 * float(errors.mean()),
        }

    def distance(pose: BoardPose, board: FlatBoard) -> float:
        centre = pose.centre(board)
        return float(centre[2] if depth_kind == "z" else np.linalg.norm(centre))

    focal, square = _CHANGES.values()
    changes = ((1 - focal, 1.0), (1 + focal, 1.0), (1.0, 1 + square))
    alternatives = [read_with(*change) for change in changes]
    return {"as_given": read_with(1.0, 1.0), "alternatives": alternatives}


def degeneracy_warning(found: dict[str, Any]) -> str:
    """Return the result of `study_degeneracy` as a sentence with numbers."""
    given, (shorter, longer, larger) = found["as_given"], found["alternatives"]
    pixels, slope, mean = "reprojection_rms_px", "slope_mm_per_m", "mean_error_mm"
    slopes = larger_slope = ""
    if given[slope] is not None:
        slopes = (
            f", yet the slope of the depth error is {shorter[slope]:+.1f} or "
            f"{longer[slope]:+.1f} instead of {given[slope]:+.1f} mm/m"
        )
    if larger[slope] is not None:
        larger_slope = f"the slope {larger[slope]:+.1f} mm/m, "
    return (
        "A board cannot tell focal length, square length and slope of the distance error "
        f"apart: with the focal length {_CHANGES['focal']:.0%} shorter or longer the reprojection "
        f"error is {shorter[pixels]:.3f} or {longer[pixels]:.3f} px "
        f"instead of {given[pixels]:.3f} px{slopes}"
        f", and its mean {shorter[mean]:+.1f} or {longer[mean]:+.1f} instead "
        f"of {given[mean]:+.1f} mm; squares {_CHANGES['square']:.0%} larger leave the "
        f"reprojection error as it is and make {larger_slope}the mean {larger[mean]:+.1f} mm. "
        "Measure the printed board, and take the focal length from a source of its own, before "
        "trusting offset and slope."
    )
