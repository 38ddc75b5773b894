"""What an import did: views used, views refused, warnings."""

import json
from dataclasses import asdict, dataclass, field
from typing import Any

from tofcorr.errors import CalibrationDataError

FILE_NAME = "import.json"


class RefusedViewError(CalibrationDataError):
    """One view cannot be used; the message says why, the import goes on without it."""


@dataclass(frozen=True, kw_only=True)
class Refusal:
    """A view that is not in the recording, and why."""

    view: str
    reason: str


@dataclass(frozen=True, kw_only=True)
class ImportedView:
    """One frame of the recording, as the import saw it.

    Attributes:
        frame: Index in the recording.
        view: What the name pattern's wildcard stands for.
        depth_file: Path of the depth image, relative to the folder.
        infrared_file: Path of the infrared image, relative to the folder.
        reprojection_rms_px: Root mean square distance of corners used to their projections.
        corners_used: Corners that determine the pose; the others are outliers.
        board_pixels: Pixels in the mask.
        usable_pixels: Of these, pixels with depth and below saturation.
        distance_m: Median radial distance of the board, from its pose.
        incidence_deg: Angle between the board's normal and the ray to its centre.
        plane_sd_mm: Standard deviation of the plane's position at the board's centre, along its
            normal, as the scatter of the corners implies it. What all views share (focal length,
            square length) comes on top.
        depth_error_mm: Median of measured minus true radial distance.
    """

    frame: int
    view: str
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


@dataclass(frozen=True, kw_only=True)
class ImportReport:
    """Everything there is to know about an import; `import.json` beside the arrays.

    Attributes:
        folder: Where the images lay.
        options: The options of the import.
        camera: Lateral parameters used, and where they came from.
        views: The frames, in order.
        refused: The views left out.
        degeneracy: What the board cannot tell apart, in numbers.
        warnings: Sentences for people.
    """

    folder: str
    options: dict[str, Any]
    camera: dict[str, Any]
    views: list[ImportedView]
    refused: list[Refusal]
    degeneracy: dict[str, Any]
    warnings: list[str] = field(default_factory=list)

    def to_json(self) -> str:
        """Return the text of `import.json`."""
        content = {"format": "tofcorr-import", "version": 1, **asdict(self)}
        return json.dumps(content, indent=1, ensure_ascii=False) + "\n"
