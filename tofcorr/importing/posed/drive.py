"""What a door hands to the import: images, poses, and what it knows besides."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tofcorr.importing.poses.track import PoseTrack
from tofcorr.importing.report import Refusal
from tofcorr.importing.source import DepthSource


@dataclass(frozen=True, kw_only=True, eq=False)
class Drive:
    """Images that a camera took while a robot was driven, and the robot's poses.

    Attributes:
        source: The images.
        track: Poses of the tool in the robot's base.
        refused: Images that the source has left out already.
        warnings: What the source has to say, sentences for people.
        targets: Which wall each image shows, shape (I,), text; None: walls are looked for.
        tool_from_camera: The hand-eye transform where it is known, shape (4, 4); else None.
    """

    source: DepthSource
    track: PoseTrack
    refused: Sequence[Refusal] = ()
    warnings: Sequence[str] = ()
    targets: np.ndarray | None = None
    tool_from_camera: np.ndarray | None = None
