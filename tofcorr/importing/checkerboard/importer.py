"""Import of depth images of a board, with the image that shows its corners beside each."""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from pydantic import Field

from tofcorr.data.recording import DepthKind
from tofcorr.data.table import FrameRow
from tofcorr.data.writing import RecordingWriter
from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.geometry.rays import ray_directions
from tofcorr.importing.checkerboard.boards import BOARDS, FlatBoard
from tofcorr.importing.checkerboard.checks import (
    BoardView,
    agreement_warnings,
    compare_depth,
    degeneracy_warning,
    refuse_mixed_up,
    study_degeneracy,
    typical_ratio,
)
from tofcorr.importing.checkerboard.pose import calibrate, calibration_warning, estimate_pose
from tofcorr.importing.images import DepthImage, files_of_views, of_size, read_image
from tofcorr.importing.intrinsics import GivenIntrinsics
from tofcorr.importing.run import (
    Frame,
    PreparedImport,
    Progress,
    Refused,
    RefusedViewError,
    Sieve,
    camera_mapping,
    no_progress,
    run_import,
)
from tofcorr.options import Options

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
CornerCount = Annotated[int, Field(ge=3)]
Files = dict[str, Path]
"""The images of one view by their kind."""


class CheckerboardOptions(Options):
    """How to read a folder of checkerboard images.

    Attributes:
        depth_pattern: Names of the depth images, with `{view}` or wildcards.
        infrared_pattern: Names of the infrared images.
        board_kind: One of `tofcorr.importing.checkerboard.boards.BOARDS`.
        board_columns: Inner corners in a row; squares or tags of other kinds.
        board_rows: The same in a column.
        board_dictionary: Of the markers; None: the kind's usual one.
        board_share: Side of the markers, or space between tags, as a share of a side; None: the
            kind's usual one.
        square_length: Side of a square or tag, metres.
        depth_unit: Metres per count of the depth images; 0 counts mean no return.
        depth_kind: `z`: along the optical axis; `radial`: along the ray.
        saturation_counts: Infrared counts from which a pixel is saturated; None: never.
        margin_squares: How far the mask extends beyond the outermost inner corners, in squares. Up
            to 0 the corners surround every pixel used; 1 is the outer edge of the squares.
        max_reprojection_px: Views with a larger reprojection error (root mean square) are refused.
        modulation_frequency: Modulation frequency of the camera, Hz; None if unknown.
    """

    depth_pattern: str = "{view}_depth.png"
    infrared_pattern: str = "{view}_ir.png"
    board_kind: Literal["checkerboard", "charuco", "apriltag"] = "checkerboard"
    board_columns: CornerCount
    board_rows: CornerCount
    board_dictionary: str | None = None
    board_share: Annotated[float, Field(gt=0.0, lt=1.0)] | None = None
    square_length: Positive
    depth_unit: Positive = 1e-3
    depth_kind: DepthKind = "z"
    saturation_counts: Positive | None = 65535.0
    margin_squares: Annotated[float, Field(gt=-1.0, le=2.0)] = 0.0
    max_reprojection_px: Positive = 0.5
    modulation_frequency: Positive | None = None

    def board(self) -> FlatBoard:
        """Return the board."""
        return BOARDS[self.board_kind](
            columns=self.board_columns,
            rows=self.board_rows,
            square_length=self.square_length,
            dictionary=self.board_dictionary or "",
            share=self.board_share or 0.0,
        )


class BoardImages(NamedTuple):
    """Depth images, each with an image that shows the board's corners.

    Attributes:
        views: The files of each view, by their kind; `depth` and `infrared` are among them.
        alone: Why other views lack some.
        with_corners: Reads the image that shows the corners, shape (H, W), from the files of a
            view; raises `RefusedViewError` if it cannot be used.
        measured: Reads depth and amplitude from them in the same way.
    """

    views: dict[str, Files]
    alone: Refused
    with_corners: Callable[[Files], np.ndarray]
    measured: Callable[[Files], DepthImage]


def sixteen_bit_images(folder: Path, options: CheckerboardOptions) -> BoardImages:
    """Return depth and infrared PNG images of 16 bits; infrared counts are the amplitudes."""

    def counts(path: Path) -> np.ndarray:
        image = read_image(path)
        if image.ndim != 2:
            raise RefusedViewError(
                f"{path.name} has {image.shape[2]} channels; one grey channel of 16 bits is needed"
            )
        if image.dtype != np.uint16:
            raise RefusedViewError(
                f"{path.name} has {8 * image.itemsize} bits a pixel; 16 are needed "
                "(an 8-bit image is only a preview of depth or amplitude)"
            )
        return image

    def measured(files: Files) -> DepthImage:
        depth, infrared = counts(files["depth"]), counts(files["infrared"])
        return DepthImage(np.where(depth > 0, depth * options.depth_unit, np.nan), infrared)

    patterns = {"depth": options.depth_pattern, "infrared": options.infrared_pattern}
    found = files_of_views(folder, patterns)
    return BoardImages(*found, lambda files: counts(files["infrared"]), measured)


def import_checkerboard(
    folder: Path,
    out: Path,
    options: CheckerboardOptions,
    intrinsics: GivenIntrinsics | None,
    progress: Progress = no_progress,
    read: Callable[[Path, CheckerboardOptions], BoardImages] = sixteen_bit_images,
) -> dict[str, Any]:
    """Turn images of a board into a recording, with `import.json` beside the arrays.

    The world is the camera frame: the plane of each frame comes from the board's corners in its own
    infrared image. A view that cannot be used is left out and listed with its reason.

    Args:
        folder: Where the images are.
        out: The recording to write; it must not exist yet.
        options: How to read the images.
        intrinsics: The camera intrinsics; None: calibrate them from the board.
        progress: Shows how far a step has come.
        read: Finds the images.

    Raises:
        CalibrationDataError: No view can be used, the intrinsics do not fit the images, a unit
            must be wrong, or `out` exists or cannot be written.
    """

    def prepare(sieve: Sieve) -> PreparedImport:
        return _prepared(folder, options, intrinsics, read(folder, options), sieve)

    return run_import(str(folder), options, prepare, out, progress)


def _prepared(
    folder: Path,
    options: CheckerboardOptions,
    intrinsics: GivenIntrinsics | None,
    images: BoardImages,
    sieve: Sieve,
) -> PreparedImport:
    """Find the boards, calibrate the camera if asked to, and place the boards."""
    board = options.board()
    sieve.refused |= images.alone
    detected: dict[str, tuple[np.ndarray, tuple[int, int]]] = {}

    def detect(view: str) -> None:
        image, files = images.with_corners(images.views[view]), images.views[view]
        # One hint is enough, and looking for a second board takes time.
        corners = _corners(image, board, files["infrared"].name, hint=not sieve.refused)
        detected[view] = corners, (image.shape[1], image.shape[0])

    def read(view: str) -> DepthImage:
        files = images.views[view]
        names = files["depth"].name, files.get("amplitude", files["infrared"]).name
        return of_size(images.measured(files), camera, names, "the other images have")

    def place(view: str) -> BoardView:
        pose = estimate_pose(detected[view][0], board, camera, options.max_reprojection_px)
        depth, amplitude = read(view)
        area = pose.area(board, rays, options.margin_squares)
        usable = np.isfinite(depth)
        if options.saturation_counts is not None and amplitude is not None:
            usable &= amplitude < options.saturation_counts
        return compare_depth(view, pose, depth, usable, area, rays, options.depth_kind)

    sieve.apply(detect, sieve.progress(list(images.views), "finding boards"), str)
    camera, about_camera, warnings = _camera(list(detected.values()), board, intrinsics)
    rays = ray_directions(camera).numpy()
    views = sieve.apply(place, sieve.progress(list(detected), "placing boards"), str)
    ratio = typical_ratio(views)
    views = sieve.apply(partial(refuse_mixed_up, ratio=ratio), views, lambda view: view.name)
    posed = [(detected[view.name][0], view.pose, view.error) for view in views]
    degeneracy = study_degeneracy(posed, board, camera, options.depth_kind)
    warnings += agreement_warnings(views, ratio, options.depth_kind)

    def frames() -> Iterator[Frame]:
        for index, view in enumerate(views):
            normal, offset = view.pose.plane()
            row = FrameRow(
                timestamp=float(index),  # The files do not say when an image was taken.
                world_from_tool=np.eye(4),
                normal_world=normal,
                offset=offset,
                target=board.kind,
            )
            depth, amplitude = read(view.name)
            yield row, depth, amplitude, view.pose.area(board, rays, options.margin_squares)

    return PreparedImport(
        views=[_reported(view, board, images.views[view.name], folder) for view in views],
        frames=frames(),
        writer=partial(
            RecordingWriter,
            camera=camera,
            depth_kind=options.depth_kind,
            modulation_frequency=options.modulation_frequency,
            saturation_amplitude=options.saturation_counts,
        ),
        camera=about_camera,
        findings={"degeneracy": degeneracy},
        warnings=[*warnings, degeneracy_warning(degeneracy)],
    )


def _corners(image: np.ndarray, board: FlatBoard, name: str, *, hint: bool) -> np.ndarray:
    """Find the board's corners in an image, shape (N, 2).

    If no board is found, a hint may try one with a row and a column fewer: a common mistake is to
    count squares instead of inner corners.
    """
    corners = board.find(image)
    if corners is not None:
        return corners
    fewer = board.fewer()
    said = ""
    if hint and fewer is not None and fewer.find(image) is not None:
        said = f", but one of {fewer}: count inner corners, not squares"
    what = f"board of {board} inner corners" if fewer else f"board {board}"
    raise RefusedViewError(f"no {what} found in {name}{said}")


def _camera(
    detected: Sequence[tuple[np.ndarray, tuple[int, int]]],
    board: FlatBoard,
    intrinsics: GivenIntrinsics | None,
) -> tuple[CameraIntrinsics, dict[str, Any], list[str]]:
    """Return the camera of the images' commonest size, what to report of it, and warnings."""
    size = Counter(size for _, size in detected).most_common(1)[0][0]
    if intrinsics is not None:
        camera = intrinsics.camera(size)
        return camera, camera_mapping(camera, intrinsics.source), []
    camera, found = calibrate([corners for corners, own in detected if own == size], board, size)
    about = camera_mapping(camera, "calibrated from the boards") | found
    return camera, about, [calibration_warning(camera, found)]


def _reported(view: BoardView, board: FlatBoard, files: Files, folder: Path) -> dict[str, Any]:
    """Return what `import.json` says of a view.

    `plane_sd_mm` is the standard deviation of the plane's position at the board's centre, along its
    normal, propagated from the corners; errors that all views share (focal length, square length)
    are not included. `depth_error_mm` is the median of measured minus true depth.
    """
    pose, centre = view.pose, view.pose.centre(board)
    cosine = abs(float(pose.plane()[0] @ centre)) / float(np.linalg.norm(centre))
    return {
        "view": view.name,
        "depth_file": files["depth"].relative_to(folder).as_posix(),
        "infrared_file": files["infrared"].relative_to(folder).as_posix(),
        "reprojection_rms_px": pose.reprojection_rms,
        "corners_used": int(pose.used.sum()),
        "board_pixels": view.board_pixels,
        "usable_pixels": view.usable_pixels,
        "distance_m": view.distance,
        "incidence_deg": float(np.degrees(np.arccos(min(cosine, 1.0)))),
        "plane_sd_mm": 1000 * pose.plane_deviation,
        "depth_error_mm": 1000 * view.error,
    }
