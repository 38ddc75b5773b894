"""The pixels that see the board."""

import numpy as np

from tofcorr.importing.checkerboard.board import FlatBoard
from tofcorr.importing.checkerboard.pose import BoardPose


def board_area(
    pose: BoardPose, board: FlatBoard, ray_directions: np.ndarray, margin: float
) -> np.ndarray:
    """Return True where the viewing ray meets the board.

    Args:
        pose: Pose of the board.
        board: The board.
        ray_directions: Unit viewing rays, shape (H, W, 3).
        margin: How far the area extends beyond the outermost points, in squares. At 0 the
            corners surround all pixels; 1 is the outer edge of the squares; negative values shrink
            the area.

    Returns:
        Shape (H, W), bool.
    """
    normal, offset = pose.plane()
    # The normal points to the camera, so the rays that meet the board have a negative cosine. The
    # limit (no unit) only excludes rays parallel to the board.
    cosine = ray_directions @ normal
    meets = cosine < -1e-6
    distance = np.where(meets, -offset / np.where(meets, cosine, -1.0), np.inf)
    on_plane = np.where(meets, distance, 0.0)[..., None] * ray_directions
    in_squares = (on_plane - pose.translation) @ pose.rotation[:, :2] / board.square_length
    low, high = board.outline()
    beyond = np.maximum(low - in_squares, in_squares - high)
    return meets & (beyond.max(axis=-1) <= margin)


def true_radial_distance(pose: BoardPose, rays: np.ndarray) -> np.ndarray:
    """Return the distance along rays of shape (..., 3) at which they meet the board's plane."""
    normal, offset = pose.plane()
    return -offset / (rays @ normal)
