"""Images of a board in a folder: the corners in a grey image, depth and amplitude beside it."""

from pathlib import Path

import numpy as np

from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.importing.checkerboard.board_images import refuse_other_sizes
from tofcorr.importing.checkerboard.importer import CheckerboardImages
from tofcorr.importing.checkerboard.options import CheckerboardOptions
from tofcorr.importing.checkerboard.pairs import ImagePair, find_pairs
from tofcorr.importing.engine import run_import
from tofcorr.importing.given_intrinsics import GivenIntrinsics
from tofcorr.importing.images.coding import DepthCoding, amplitude_counts, depth_metres, turned
from tofcorr.importing.images.decode import read_array, read_grey
from tofcorr.importing.images.series import find_series
from tofcorr.importing.report import ImportReport, Refusal
from tofcorr.importing.sieve import Progress, no_progress

_CORNERS_ONLY = "Name it with --grey alone: it serves to find corners"


def import_boards(
    folder: Path,
    out: Path,
    options: CheckerboardOptions,
    coding: DepthCoding,
    intrinsics: GivenIntrinsics | None,
    *,
    amplitude_pattern: str | None,
    progress: Progress = no_progress,
) -> ImportReport:
    """Turn images of a board into a recording, without a robot.

    Args:
        folder: Where the images are.
        out: The recording to write; it must not exist yet.
        options: The board; `infrared_pattern` names the images in which its corners are found.
        coding: How depth is to be read.
        intrinsics: The camera intrinsics; None: calibrate them from the board.
        amplitude_pattern: Names of the amplitude images; None: there are none.
        progress: Shows how far a step has come.

    Raises:
        CalibrationDataError: As `tofcorr.importing.checkerboard.importer.import_checkerboard`.
    """
    images = FolderBoardImages(folder, options, coding, amplitude_pattern)
    source = CheckerboardImages(folder, options, intrinsics, images)
    return run_import(source, out, progress)


class FolderBoardImages:
    """A `tofcorr.importing.checkerboard.board_images.BoardImages` of all formats."""

    def __init__(
        self,
        folder: Path,
        options: CheckerboardOptions,
        coding: DepthCoding,
        amplitude_pattern: str | None,
    ) -> None:
        self._folder, self._options, self._coding = folder, options, coding
        self._amplitude: dict[str, Path] | None = None
        if amplitude_pattern is not None:
            found = find_series(folder, amplitude_pattern, "amplitude")
            self._amplitude = dict(zip(found.views, found.paths, strict=True))

    def pairs(self) -> tuple[list[ImagePair], list[Refusal]]:
        """Return the pairs, and the images without their partner."""
        options = self._options
        pairs, alone = find_pairs(self._folder, options.depth_pattern, options.infrared_pattern)
        if self._amplitude is None:
            return pairs, alone
        whole = [pair for pair in pairs if pair.view in self._amplitude]
        alone += [
            Refusal(view=pair.view, reason="there is no amplitude image beside it")
            for pair in pairs
            if pair.view not in self._amplitude
        ]
        return whole, alone

    def with_corners(self, pair: ImagePair) -> np.ndarray:
        """Return the grey image, shape (H, W)."""
        return turned(read_grey(pair.infrared), self._coding.rotate)

    def measured(
        self, pair: ImagePair, camera: CameraIntrinsics
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Return depth in metres and amplitude, each of shape (H, W)."""
        depth = depth_metres(read_array(pair.depth), self._coding, pair.depth.name)
        refuse_other_sizes(((pair.depth, depth),), camera)
        if self._amplitude is None:
            return depth, None
        path = self._amplitude[pair.view]
        amplitude = amplitude_counts(read_array(path), self._coding, path.name, _CORNERS_ONLY)
        refuse_other_sizes(((path, amplitude),), camera)
        return depth, amplitude
