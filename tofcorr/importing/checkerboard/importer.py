"""Import of depth and infrared images of a checkerboard."""

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from tofcorr.data.table import FrameRow
from tofcorr.data.writing import RecordingWriter
from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.geometry.rays import ray_directions
from tofcorr.importing.checkerboard.agreement import (
    agreement_warnings,
    refuse_mixed_up,
    typical_ratio,
)
from tofcorr.importing.checkerboard.board_area import board_area
from tofcorr.importing.checkerboard.board_images import BoardImages, CountImages
from tofcorr.importing.checkerboard.calibration import calibrate
from tofcorr.importing.checkerboard.degeneracy import Degeneracy, PosedView, study_degeneracy
from tofcorr.importing.checkerboard.options import CheckerboardOptions
from tofcorr.importing.checkerboard.views import (
    DetectedView,
    PosedBoardView,
    detect,
    place,
)
from tofcorr.importing.engine import ImportedFrame, PreparedImport, camera_mapping, run_import
from tofcorr.importing.given_intrinsics import GivenIntrinsics
from tofcorr.importing.report import ImportReport
from tofcorr.importing.sieve import Progress, Sieve, no_progress


def import_checkerboard(
    folder: Path,
    out: Path,
    options: CheckerboardOptions,
    intrinsics: GivenIntrinsics | None,
    progress: Progress = no_progress,
) -> ImportReport:
    """Turn images of a checkerboard into a recording, with `import.json` beside the arrays.

    The world is the camera frame: the plane of each frame comes from the board's corners in its own
    infrared image. A view that cannot be used is left out and listed with its reason.

    Args:
        folder: Where the images are.
        out: The recording to write; it must not exist yet.
        options: How to read the images.
        intrinsics: The camera intrinsics; None: calibrate them from the board.
        progress: Shows how far a step has come.

    Raises:
        CalibrationDataError: No view can be used, the intrinsics do not fit the images, a unit
            must be wrong, or `out` exists or cannot be written.
    """
    return run_import(CheckerboardImages(folder, options, intrinsics), out, progress)


class CheckerboardImages:
    """A folder of depth and infrared images of a board.

    Args:
        folder: Where the images are.
        options: How to read them.
        intrinsics: The camera intrinsics; None: calibrate them from the board.
        images: Reads the images; None: PNG of 16 bits.
    """

    def __init__(
        self,
        folder: Path,
        options: CheckerboardOptions,
        intrinsics: GivenIntrinsics | None,
        images: BoardImages | None = None,
    ) -> None:
        self.folder = folder
        self.options = options
        self._intrinsics = intrinsics
        self._board = options.board()
        self._images = images or CountImages(folder, options)

    def prepare(self, sieve: Sieve) -> PreparedImport:
        """Find the boards, calibrate the camera if asked to, and place the boards."""
        options = self.options
        detected = self._detected(sieve)
        camera, about_camera, warnings = self._camera(detected)
        views = self._placed(detected, camera, sieve)
        degeneracy = self._degeneracy(views, camera)
        warnings += agreement_warnings([view.agreement for view in views], options.depth_kind)
        rays = ray_directions(camera).numpy()
        return PreparedImport(
            views=[view.reported(i, self._board, self.folder) for i, view in enumerate(views)],
            frame=lambda index: self._frame(index, views[index], camera, rays),
            open_writer=lambda path: RecordingWriter(
                path,
                camera=camera,
                depth_kind=options.depth_kind,
                modulation_frequency=options.modulation_frequency,
                saturation_amplitude=options.saturation_counts,
            ),
            camera=about_camera,
            findings={"degeneracy": degeneracy.to_mapping()},
            warnings=[*warnings, degeneracy.warning()],
        )

    def _detected(self, sieve: Sieve) -> list[DetectedView]:
        pairs, alone = self._images.pairs()
        sieve.refused += alone
        return sieve.apply(
            # One hint is enough, and looking for a second board takes time.
            lambda pair: detect(
                pair, self._images, self._board, look_for_smaller=not sieve.refused
            ),
            sieve.progress(pairs, "finding boards"),
            lambda pair: pair.view,
        )

    def _camera(
        self, detected: list[DetectedView]
    ) -> tuple[CameraIntrinsics, dict[str, Any], list[str]]:
        """Return the camera, what to report of it, and warnings."""
        size = Counter(view.size for view in detected).most_common(1)[0][0]
        if self._intrinsics is not None:
            camera = self._intrinsics.camera(size)
            return camera, camera_mapping(camera, self._intrinsics.source), []
        corners = [view.corners for view in detected if view.size == size]
        calibration = calibrate(corners, self._board, size)
        about = camera_mapping(calibration.camera, "calibrated from the boards") | {
            "reprojection_rms_px": calibration.reprojection_rms,
            "standard_deviations": calibration.standard_deviations.tolist(),
            "views": calibration.num_views,
            "outlying_corners": calibration.num_outliers,
        }
        return calibration.camera, about, [calibration.warning()]

    def _placed(
        self, detected: list[DetectedView], camera: CameraIntrinsics, sieve: Sieve
    ) -> list[PosedBoardView]:
        rays = ray_directions(camera).numpy()
        views = sieve.apply(
            lambda view: place(view, self._images, self.options, camera, rays),
            sieve.progress(detected, "placing boards"),
            lambda view: view.pair.view,
        )
        ratio = typical_ratio([view.agreement for view in views])

        def checked(view: PosedBoardView) -> PosedBoardView:
            refuse_mixed_up(view.agreement, ratio)
            return view

        return sieve.apply(checked, views, lambda view: view.pair.view)

    def _degeneracy(self, views: list[PosedBoardView], camera: CameraIntrinsics) -> Degeneracy:
        posed = [
            PosedView(corners=view.corners, pose=view.pose, depth_error=view.agreement.error)
            for view in views
        ]
        return study_degeneracy(posed, self._board, camera, self.options.depth_kind)

    def _frame(
        self, index: int, view: PosedBoardView, camera: CameraIntrinsics, rays: np.ndarray
    ) -> ImportedFrame:
        depth, amplitude = self._images.measured(view.pair, camera)
        normal, offset = view.pose.plane()
        row = FrameRow(
            timestamp=float(index),  # The files do not say when an image was taken.
            world_from_tool=np.eye(4),
            normal_world=normal,
            offset=offset,
            target=self._board.kind,
        )
        area = board_area(view.pose, self._board, rays, self.options.margin_squares)
        return ImportedFrame(row=row, depth=depth, amplitude=amplitude, mask=area)
