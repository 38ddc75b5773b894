"""Cameras of the tests."""

from tofcorr.geometry.camera import CameraIntrinsics


def camera(
    size: tuple[int, int],
    focal: tuple[float, float],
    centre: tuple[float, float],
    *distortion: float,
) -> CameraIntrinsics:
    """Return a camera of a size (width, height), focal lengths and a principal point in pixels."""
    matrix = ((focal[0], 0.0, centre[0]), (0.0, focal[1], centre[1]), (0.0, 0.0, 1.0))
    return CameraIntrinsics(width=size[0], height=size[1], matrix=matrix, distortion=distortion)
