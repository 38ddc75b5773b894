"""One view of a board: its corners, its pose, and how its depth compares with the pose."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.importing.checkerboard.agreement import DepthAgreement, compare_depth
from tofcorr.importing.checkerboard.board import FlatBoard
from tofcorr.importing.checkerboard.board_area import board_area
from tofcorr.importing.checkerboard.board_images import BoardImages
from tofcorr.importing.checkerboard.options import CheckerboardOptions
from tofcorr.importing.checkerboard.pairs import ImagePair
from tofcorr.importing.checkerboard.pose import BoardPose, estimate_pose
from tofcorr.importing.checkerboard.view_report import CheckerboardView
from tofcorr.importing.report import RefusedViewError


@dataclass(frozen=True, kw_only=True)
class DetectedView:
    """A view whose board was found.

    Attributes:
        pair: Its two images.
        corners: Pixel coordinates of the inner corners, shape (N, 2).
        size: Width and height of the infrared image.
    """

    pair: ImagePair
    corners: np.ndarray
    size: tuple[int, int]


@dataclass(frozen=True, kw_only=True)
class PosedBoardView:
    """A view whose board has a pose.

    Attributes:
        pair: Its two images.
        corners: Pixel coordinates of the inner corners, shape (N, 2).
        pose: The board in the camera frame.
        board_pixels: Number of pixels that see the board.
        agreement: The measured depth against the pose.
    """

    pair: ImagePair
    corners: np.ndarray
    pose: BoardPose
    board_pixels: int
    agreement: DepthAgreement

    def reported(self, frame: int, board: FlatBoard, folder: Path) -> CheckerboardView:
        """Return what `import.json` says of the view."""
        centre = self.pose.centre(board)
        cosine = abs(float(self.pose.plane()[0] @ centre)) / float(np.linalg.norm(centre))
        return CheckerboardView(
            frame=frame,
            view=self.pair.view,
            depth_file=self.pair.depth.relative_to(folder).as_posix(),
            infrared_file=self.pair.infrared.relative_to(folder).as_posix(),
            reprojection_rms_px=self.pose.reprojection_rms,
            corners_used=int(self.pose.used.sum()),
            board_pixels=self.board_pixels,
            usable_pixels=self.agreement.usable_pixels,
            distance_m=self.agreement.distance,
            incidence_deg=float(np.degrees(np.arccos(min(cosine, 1.0)))),
            plane_sd_mm=1e3 * self.pose.plane_deviation,
            depth_error_mm=1e3 * self.agreement.error,
        )


def detect(
    pair: ImagePair, images: BoardImages, board: FlatBoard, *, look_for_smaller: bool
) -> DetectedView:
    """Find the board in the infrared image.

    Args:
        pair: The two images.
        images: Reads them.
        board: What to look for.
        look_for_smaller: If no board is found, also try one with a row and a column fewer and say
            so: a common mistake is to count squares instead of inner corners.

    Raises:
        RefusedViewError: The image cannot be read, or shows no such board.
    """
    infrared = images.with_corners(pair)
    corners = board.find(infrared)
    if corners is None:
        hint = _smaller_board_hint(infrared, board) if look_for_smaller else ""
        what = f"board of {board} inner corners" if board.fewer() else f"board {board}"
        raise RefusedViewError(f"no {what} found in {pair.infrared.name}{hint}")
    size = (infrared.shape[1], infrared.shape[0])
    return DetectedView(pair=pair, corners=corners, size=size)


def place(
    view: DetectedView,
    images: BoardImages,
    options: CheckerboardOptions,
    camera: CameraIntrinsics,
    rays: np.ndarray,
) -> PosedBoardView:
    """Estimate the pose of the board and compare the depth image with it.

    Args:
        view: The view.
        images: Reads them.
        options: How to use them.
        camera: The camera intrinsics.
        rays: Unit viewing rays, shape (H, W, 3).

    Raises:
        RefusedViewError: No pose fits the corners, or the depth image does not fit the pose.
    """
    board = options.board()
    pose = estimate_pose(view.corners, board, camera, options.max_reprojection_px)
    depth, amplitude = images.measured(view.pair, camera)
    area = board_area(pose, board, rays, options.margin_squares)
    usable = np.isfinite(depth)
    if options.saturation_counts is not None and amplitude is not None:
        usable &= amplitude < options.saturation_counts
    agreement = compare_depth(depth, usable, area, pose, rays, options.depth_kind)
    return PosedBoardView(
        pair=view.pair,
        corners=view.corners,
        pose=pose,
        board_pixels=int(area.sum()),
        agreement=agreement,
    )


def _smaller_board_hint(infrared: np.ndarray, board: FlatBoard) -> str:
    fewer = board.fewer()
    if fewer is None or fewer.find(infrared) is None:
        return ""
    return f", but one of {fewer}: count inner corners, not squares"
