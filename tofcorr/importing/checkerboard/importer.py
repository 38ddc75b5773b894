"""Import of depth and infrared images of a checkerboard."""

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from tofcorr.data.header import DepthKind
from tofcorr.data.staging import StagedFolder
from tofcorr.data.table import FrameRow
from tofcorr.data.writing import RecordingWriter
from tofcorr.errors import CalibrationDataError
from tofcorr.geometry.intrinsics import CameraIntrinsics
from tofcorr.geometry.rays import ray_directions
from tofcorr.importing import report
from tofcorr.importing.checkerboard.agreement import (
    DepthAgreement,
    agreement_warnings,
    compare_depth,
    refuse_mixed_up,
    typical_ratio,
)
from tofcorr.importing.checkerboard.board import Board
from tofcorr.importing.checkerboard.board_area import board_area
from tofcorr.importing.checkerboard.calibration import calibrate
from tofcorr.importing.checkerboard.degeneracy import Degeneracy, PosedView, study_degeneracy
from tofcorr.importing.checkerboard.detection import find_corners
from tofcorr.importing.checkerboard.images import read_counts, size_text
from tofcorr.importing.checkerboard.options import CheckerboardOptions
from tofcorr.importing.checkerboard.pairs import ImagePair, find_pairs
from tofcorr.importing.checkerboard.pose import BoardPose, estimate_pose
from tofcorr.importing.lens import Lens
from tofcorr.importing.report import ImportedView, ImportReport, Refusal, RefusedViewError

Item = TypeVar("Item")
Progress = Callable[[Iterable[Item], str], Iterable[Item]]


@dataclass(frozen=True, kw_only=True)
class _View:
    """A view on its way into the recording."""

    pair: ImagePair
    corners: np.ndarray
    pose: BoardPose
    board_pixels: int
    agreement: DepthAgreement


class _Importer:
    """Carries what all steps share: options, progress, and the views refused so far."""

    def __init__(self, folder: Path, options: CheckerboardOptions, progress: Progress) -> None:
        self.folder = folder
        self.options = options
        self.board = options.board()
        self.progress = progress
        self.refused: list[Refusal] = []

    def sift(self, views: Iterable[Item], name: Callable[[Item], str], step: Callable) -> list:
        """Apply `step` to each view and set aside those it refuses."""
        results = []
        for view in views:
            try:
                results.append(step(view))
            except RefusedViewError as refusal:
                self.refused.append(Refusal(view=name(view), reason=str(refusal)))
        if not results:
            raise CalibrationDataError(self._nothing_left())
        return results

    def detect(self, pair: ImagePair) -> tuple[ImagePair, np.ndarray, tuple[int, int]]:
        """Return the pair, the board's corners and the image size (width, height)."""
        infrared = read_counts(pair.infrared)
        corners = find_corners(infrared, self.board)
        if corners is None:
            raise RefusedViewError(
                f"no board of {self.board} inner corners found in {pair.infrared.name}"
                f"{self._hint(infrared)}"
            )
        return pair, corners, (infrared.shape[1], infrared.shape[0])

    def place(
        self, pair: ImagePair, corners: np.ndarray, camera: CameraIntrinsics, rays: np.ndarray
    ) -> _View:
        """Estimate the board's pose and hold the depth image against it."""
        pose = estimate_pose(corners, self.board, camera, self.options.max_reprojection_px)
        depth, infrared = self.read(pair, camera)
        area = board_area(pose, self.board, rays, self.options.margin_squares)
        usable = np.isfinite(depth)
        if self.options.saturation_counts is not None:
            usable &= infrared < self.options.saturation_counts
        agreement = compare_depth(depth, usable, area, pose, rays, self.options.depth_kind)
        return _View(
            pair=pair,
            corners=corners,
            pose=pose,
            board_pixels=int(area.sum()),
            agreement=agreement,
        )

    def read(self, pair: ImagePair, camera: CameraIntrinsics) -> tuple[np.ndarray, np.ndarray]:
        """Return depth in metres (NaN: no return) and infrared counts."""
        depth, infrared = read_counts(pair.depth), read_counts(pair.infrared)
        for path, image in ((pair.infrared, infrared), (pair.depth, depth)):
            if image.shape != (camera.height, camera.width):
                raise RefusedViewError(
                    f"{path.name} has {size_text(image.shape)} pixels, the other images have "
                    f"{camera.width}x{camera.height}"
                )
        return np.where(depth > 0, depth * self.options.depth_unit, np.nan), infrared

    def _hint(self, infrared: np.ndarray) -> str:
        """Look for the board that is meant when squares were counted, not inner corners."""
        board = self.board
        if min(board.columns, board.rows) <= 3 or self.refused:
            return ""  # Once is enough.
        fewer = Board(columns=board.columns - 1, rows=board.rows - 1, square_length=1.0)
        if find_corners(infrared, fewer) is None:
            return ""
        return f", but one of {fewer}: count inner corners, not squares"

    def _nothing_left(self) -> str:
        reasons = [refusal.reason for refusal in self.refused]
        text = f"{self.folder}: none of {len(reasons)} views can be imported; the first: "
        return f"{text}{reasons[0]}."


def no_progress(items: Iterable[Item], _: str) -> Iterable[Item]:
    """Show nothing."""
    return items


def import_checkerboard(
    folder: Path,
    out: Path,
    options: CheckerboardOptions,
    lens: Lens | None,
    progress: Progress = no_progress,
) -> ImportReport:
    """Turn images of a checkerboard into a recording, with `import.json` beside the arrays.

    The world is the camera frame: each frame's plane comes from the board's corners in its own
    infrared image. A view that cannot be used is left out and listed with its reason.

    Args:
        folder: Where the images lie.
        out: The recording to write; nothing may be there yet.
        options: How to read the images.
        lens: The lateral parameters; None: calibrate them from the board.
        progress: Wraps an iterable to show how far a step (its name) has come.

    Raises:
        CalibrationDataError: No view can be used, the lateral parameters do not fit the images, a
            unit must be wrong, or `out` exists or cannot be written.
    """
    with StagedFolder(out) as stage:
        importer = _Importer(folder, options, progress)
        pairs, importer.refused = find_pairs(
            folder, options.depth_pattern, options.infrared_pattern
        )
        found = importer.sift(
            progress(pairs, "finding boards"), lambda pair: pair.view, importer.detect
        )
        camera, camera_report, warnings = _camera(found, lens, importer.board)
        views = _placed_views(importer, found, camera)
        degeneracy = _degeneracy(views, importer.board, camera, options.depth_kind)
        warnings += agreement_warnings([v.agreement for v in views], options.depth_kind)
        result = ImportReport(
            folder=str(folder),
            options=options.to_mapping(),
            camera=camera_report,
            views=[_imported(frame, view, importer) for frame, view in enumerate(views)],
            refused=importer.refused,
            degeneracy=degeneracy.to_mapping(),
            warnings=[*warnings, degeneracy.warning()],
        )
        _write(stage.folder, importer, views, camera)
        (stage.folder / report.FILE_NAME).write_text(result.to_json(), encoding="utf-8")
    return result


def _camera(
    found: list[tuple[ImagePair, np.ndarray, tuple[int, int]]], lens: Lens | None, board: Board
) -> tuple[CameraIntrinsics, dict[str, Any], list[str]]:
    """Return the camera, what to report of it, and warnings."""
    size = Counter(size for _, _, size in found).most_common(1)[0][0]
    if lens is not None:
        camera = lens.camera(size)
        return camera, _camera_mapping(camera, lens.source), []
    calibration = calibrate([corners for _, corners, s in found if s == size], board, size)
    about = _camera_mapping(calibration.camera, "calibrated from the boards") | {
        "reprojection_rms_px": calibration.reprojection_rms,
        "standard_deviations": calibration.standard_deviations.tolist(),
        "views": calibration.num_views,
        "outlying_corners": calibration.num_outliers,
    }
    return calibration.camera, about, [calibration.warning()]


def _camera_mapping(camera: CameraIntrinsics, source: str) -> dict[str, Any]:
    return {
        "source": source,
        "width": camera.width,
        "height": camera.height,
        "K": camera.matrix,
        "distortion": camera.distortion,
    }


def _placed_views(
    importer: _Importer,
    found: list[tuple[ImagePair, np.ndarray, tuple[int, int]]],
    camera: CameraIntrinsics,
) -> list[_View]:
    rays = ray_directions(camera).numpy()
    views = importer.sift(
        importer.progress(found, "placing boards"),
        lambda item: item[0].view,
        lambda item: importer.place(item[0], item[1], camera, rays),
    )
    ratio = typical_ratio([view.agreement for view in views])

    def checked(view: _View) -> _View:
        refuse_mixed_up(view.agreement, ratio)
        return view

    return importer.sift(views, lambda view: view.pair.view, checked)


def _degeneracy(
    views: list[_View], board: Board, camera: CameraIntrinsics, depth_kind: DepthKind
) -> Degeneracy:
    posed = [
        PosedView(corners=view.corners, pose=view.pose, depth_error=view.agreement.error)
        for view in views
    ]
    return study_degeneracy(posed, board, camera, depth_kind)


def _imported(frame: int, view: _View, importer: _Importer) -> ImportedView:
    centre = view.pose.centre(importer.board)
    cosine = abs(float(view.pose.plane()[0] @ centre)) / float(np.linalg.norm(centre))
    return ImportedView(
        frame=frame,
        view=view.pair.view,
        depth_file=view.pair.depth.relative_to(importer.folder).as_posix(),
        infrared_file=view.pair.infrared.relative_to(importer.folder).as_posix(),
        reprojection_rms_px=view.pose.reprojection_rms,
        corners_used=int(view.pose.used.sum()),
        board_pixels=view.board_pixels,
        usable_pixels=view.agreement.usable_pixels,
        distance_m=view.agreement.distance,
        incidence_deg=float(np.degrees(np.arccos(min(cosine, 1.0)))),
        plane_sd_mm=1e3 * view.pose.plane_deviation,
        depth_error_mm=1e3 * view.agreement.error,
    )


def _write(folder: Path, importer: _Importer, views: list[_View], camera: CameraIntrinsics) -> None:
    """Write the recording's files into `folder`."""
    options = importer.options
    rays = ray_directions(camera).numpy()
    inner = folder / "recording"
    with RecordingWriter(
        inner,
        camera=camera,
        depth_kind=options.depth_kind,
        modulation_frequency=options.modulation_frequency,
        saturation_amplitude=options.saturation_counts,
    ) as writer:
        for frame, view in enumerate(importer.progress(views, "writing")):
            depth, infrared = importer.read(view.pair, camera)
            normal, offset = view.pose.plane()
            row = FrameRow(
                timestamp=float(frame),  # When an image was taken its file does not say.
                world_from_tool=np.eye(4),
                normal_world=normal,
                offset=offset,
                target="checkerboard",
            )
            area = board_area(view.pose, importer.board, rays, options.margin_squares)
            writer.append(depth, row=row, amplitude=infrared, mask=area)
    for path in inner.iterdir():
        path.rename(folder / path.name)
    inner.rmdir()
