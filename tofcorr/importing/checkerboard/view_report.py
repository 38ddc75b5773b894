"""What `import.json` says of each view of a checkerboard."""

from dataclasses import dataclass

from tofcorr.importing.report import ImportedView


@dataclass(frozen=True, kw_only=True)
class CheckerboardView(ImportedView):
    """One frame of the recording; `view` is what the wildcard of the file names stands for.

    Attributes:
        depth_file: Path of the depth image, relative to the folder.
        infrared_file: Path of the infrared image, relative to the folder.
        reprojection_rms_px: Root mean square distance of the corners used to their projections.
        corners_used: Corners that determine the pose; the others are outliers.
        board_pixels: Pixels in the mask.
        usable_pixels: Of these, pixels with depth and below saturation.
        distance_m: Median radial distance of the board, from its pose.
        incidence_deg: Angle between the board's normal and the ray to its centre.
        plane_sd_mm: Standard deviation of the plane's position at the board's centre, along its
            normal, propagated from the corners. Errors that all views share (focal length, square
            length) are not included.
        depth_error_mm: Median of measured minus true radial distance.
    """

    depth_file: str
    infrared_file: str
    reprojection_rms_px: float
    corners_used: int
    board_pixels: int
    usable_pixels: int
    distance_m: float
    incidence_deg: float
    plane_sd_mm: float
    depth_error_mm: float
