"""Import of depth images of a board, with the image that shows its corners beside each."""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from pydantic import Field

from tofcorr.data.recording import DepthKind
from tofcorr.data.table import FrameRow
from tofcorr.data.writing import RecordingWriter
from tofcorr.errors import CalibrationDataError
from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.geometry.rays import ray_directions
from tofcorr.importing.checkerboard.boards import BOARDS, FlatBoard
from tofcorr.importing.checkerboard.checks import (
    DepthAgreement,
    agreement_warnings,
    compare_depth,
    degeneracy_warning,
    refuse_mixed_up,
    study_degeneracy,
    typical_ratio,
)
from tofcorr.importing.checkerboard.pose import (
    BoardPose,
    calibrate,
    calibration_warning,
    estimate_pose,
)
from tofcorr.importing.images import matching_files, natural_order, read_image
from tofcorr.importing.intrinsics import GivenIntrinsics
from tofcorr.importing.run import (
    Frame,
    PreparedImport,
    Progress,
    Refusal,
    RefusedViewError,
    Sieve,
    camera_mapping,
    no_progress,
    run_import,
)
from tofcorr.options import Options

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
CornerCount = Annotated[int, Field(ge=3)]


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


class ImagePair(NamedTuple):
    """The two images of one view."""

    view: str
    depth: Path
    infrared: Path


class BoardImages(NamedTuple):
    """Pairs of a depth image and an image that shows the board's corners.

    Attributes:
        pairs: The pairs.
        alone: The images without their partner.
        with_corners: Reads the image that shows the corners, shape (H, W); raises
            `RefusedViewError` if it cannot be used.
        measured: Reads depth in metres (NaN: no return) and amplitude, each of shape (H, W);
            raises `RefusedViewError` if one cannot be used, or has another size than the camera.
    """

    pairs: Sequence[ImagePair]
    alone: Sequence[Refusal]
    with_corners: Callable[[ImagePair], np.ndarray]
    measured: Callable[[ImagePair, CameraIntrinsics], tuple[np.ndarray, np.ndarray | None]]


def find_pairs(
    folder: Path, depth_pattern: str, infrared_pattern: str
) -> tuple[list[ImagePair], list[Refusal]]:
    """Pair the images whose wildcards match the same text.

    Images are never paired by their order: one missing file would shift all that follow.

    Args:
        folder: The folder that the patterns are relative to.
        depth_pattern: File name with `{view}`, or a glob with `*` and `?`; may name sub-folders.
        infrared_pattern: The same for the infrared images.

    Returns:
        The pairs in natural order (2 before 10), and a refusal for each image without its partner.

    Raises:
        CalibrationDataError: There is no such folder, a pattern has no wildcard or matches
            nothing, or no two images belong together.
    """
    depth = matching_files(folder, depth_pattern, "depth")
    infrared = matching_files(folder, infrared_pattern, "infrared")
    pairs = [ImagePair(v, path, infrared[v]) for v, path in depth.items() if v in infrared]
    if not pairs:
        first, other = (next(iter(found.values())).name for found in (depth, infrared))
        raise CalibrationDataError(
            f"{folder}: no depth image has an infrared image of the same name: '{depth_pattern}' "
            f"matches '{first}', '{infrared_pattern}' matches '{other}'. The "
            "text that {view} (or *) matches must be the same in both."
        )
    alone = [
        Refusal(v, f"{path.name} has no {other} image beside it")
        for mine, other, theirs in ((depth, "infrared", infrared), (infrared, "depth", depth))
        for v, path in mine.items()
        if v not in theirs
    ]
    return pairs, sorted(alone, key=lambda refusal: natural_order(refusal.view))


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

    def measured(pair: ImagePair, camera: CameraIntrinsics) -> tuple[np.ndarray, np.ndarray]:
        depth, infrared = counts(pair.depth), counts(pair.infrared)
        refuse_other_size(pair.infrared, infrared, camera)
        refuse_other_size(pair.depth, depth, camera)
        return np.where(depth > 0, depth * options.depth_unit, np.nan), infrared

    found = find_pairs(folder, options.depth_pattern, options.infrared_pattern)
    return BoardImages(*found, lambda pair: counts(pair.infrared), measured)


def refuse_other_size(path: Path, image: np.ndarray, camera: CameraIntrinsics) -> None:
    """Refuse an image of another size than the camera's.

    Raises:
        RefusedViewError: It has another size; the message names its file.
    """
    if image.shape != (camera.height, camera.width):
        raise RefusedViewError(
            f"{path.name} has {image.shape[1]}x{image.shape[0]} pixels, the other images have "
            f"{camera.width}x{camera.height}"
        )


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


@dataclass(frozen=True, kw_only=True)
class BoardView:
    """A view whose board has a pose.

    Attributes:
        pair: Its two images.
        corners: Pixel coordinates of the points, shape (N, 2).
        pose: The board in the camera frame.
        pixels: Number of pixels that see the board.
        agreement: The measured depth against the pose.
    """

    pair: ImagePair
    corners: np.ndarray
    pose: BoardPose
    pixels: int
    agreement: DepthAgreement


def _prepared(
    folder: Path,
    options: CheckerboardOptions,
    intrinsics: GivenIntrinsics | None,
    images: BoardImages,
    sieve: Sieve,
) -> PreparedImport:
    """Find the boards, calibrate the camera if asked to, and place the boards."""
    board = options.board()
    sieve.refused += images.alone
    detected = sieve.apply(
        # One hint is enough, and looking for a second board takes time.
        lambda pair: _detected(pair, images, board, look_for_smaller=not sieve.refused),
        sieve.progress(images.pairs, "finding boards"),
        lambda pair: pair.view,
    )
    camera, about_camera, warnings = _camera(detected, board, intrinsics)
    rays = ray_directions(camera).numpy()
    views = sieve.apply(
        lambda one: _placed(one[0], one[1], images, options, camera, rays),
        sieve.progress(detected, "placing boards"),
        lambda one: one[0].view,
    )
    ratio = typical_ratio([view.agreement for view in views])

    def checked(view: BoardView) -> BoardView:
        refuse_mixed_up(view.agreement, ratio)
        return view

    views = sieve.apply(checked, views, lambda view: view.pair.view)
    posed = [(view.corners, view.pose, view.agreement.error) for view in views]
    degeneracy = study_degeneracy(posed, board, camera, options.depth_kind)
    warnings += agreement_warnings([view.agreement for view in views], options.depth_kind)
    return PreparedImport(
        views=[_reported(view, board, folder) for view in views],
        frames=_frames(views, board, images, camera, rays, options.margin_squares),
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


def _detected(
    pair: ImagePair, images: BoardImages, board: FlatBoard, *, look_for_smaller: bool
) -> tuple[ImagePair, np.ndarray, tuple[int, int]]:
    """Find the board's corners in an image, shape (N, 2); return the image's size too.

    If no board is found, one with a row and a column fewer may be tried: a common mistake is to
    count squares instead of inner corners.
    """
    image = images.with_corners(pair)
    corners = board.find(image)
    if corners is not None:
        return pair, corners, (image.shape[1], image.shape[0])
    fewer = board.fewer()
    hint = ""
    if look_for_smaller and fewer is not None and fewer.find(image) is not None:
        hint = f", but one of {fewer}: count inner corners, not squares"
    what = f"board of {board} inner corners" if fewer else f"board {board}"
    raise RefusedViewError(f"no {what} found in {pair.infrared.name}{hint}")


def _camera(
    detected: Sequence[tuple[ImagePair, np.ndarray, tuple[int, int]]],
    board: FlatBoard,
    intrinsics: GivenIntrinsics | None,
) -> tuple[CameraIntrinsics, dict[str, Any], list[str]]:
    """Return the camera of the images' commonest size, what to report of it, and warnings."""
    size = Counter(size for _, _, size in detected).most_common(1)[0][0]
    if intrinsics is not None:
        camera = intrinsics.camera(size)
        return camera, camera_mapping(camera, intrinsics.source), []
    corners = [corners for _, corners, own in detected if own == size]
    camera, found = calibrate(corners, board, size)
    about = camera_mapping(camera, "calibrated from the boards") | found
    return camera, about, [calibration_warning(camera, found)]


def _placed(
    pair: ImagePair,
    corners: np.ndarray,
    images: BoardImages,
    options: CheckerboardOptions,
    camera: CameraIntrinsics,
    rays: np.ndarray,
) -> BoardView:
    """Estimate the pose of the board and compare the depth image with it."""
    board = options.board()
    pose = estimate_pose(corners, board, camera, options.max_reprojection_px)
    depth, amplitude = images.measured(pair, camera)
    area = pose.area(board, rays, options.margin_squares)
    usable = np.isfinite(depth)
    if options.saturation_counts is not None and amplitude is not None:
        usable &= amplitude < options.saturation_counts
    agreement = compare_depth(depth, usable, area, pose, rays, options.depth_kind)
    pixels = int(area.sum())
    return BoardView(pair=pair, corners=corners, pose=pose, pixels=pixels, agreement=agreement)


def _reported(view: BoardView, board: FlatBoard, folder: Path) -> dict[str, Any]:
    """Return what `import.json` says of a view.

    `plane_sd_mm` is the standard deviation of the plane's position at the board's centre, along its
    normal, propagated from the corners; errors that all views share (focal length, square length)
    are not included. `depth_error_mm` is the median of measured minus true depth.
    """
    pose, agreement, centre = view.pose, view.agreement, view.pose.centre(board)
    cosine = abs(float(pose.plane()[0] @ centre)) / float(np.linalg.norm(centre))
    return {
        "view": view.pair.view,
        "depth_file": view.pair.depth.relative_to(folder).as_posix(),
        "infrared_file": view.pair.infrared.relative_to(folder).as_posix(),
        "reprojection_rms_px": pose.reprojection_rms,
        "corners_used": int(pose.used.sum()),
        "board_pixels": view.pixels,
        "usable_pixels": agreement.usable_pixels,
        "distance_m": agreement.distance,
        "incidence_deg": float(np.degrees(np.arccos(min(cosine, 1.0)))),
        "plane_sd_mm": 1e3 * pose.plane_deviation,
        "depth_error_mm": 1e3 * agreement.error,
    }


def _frames(
    views: Sequence[BoardView],
    board: FlatBoard,
    images: BoardImages,
    camera: CameraIntrinsics,
    rays: np.ndarray,
    margin: float,
) -> Iterator[Frame]:
    for index, view in enumerate(views):
        normal, offset = view.pose.plane()
        row = FrameRow(
            timestamp=float(index),  # The files do not say when an image was taken.
            world_from_tool=np.eye(4),
            normal_world=normal,
            offset=offset,
            target=board.kind,
        )
        yield row, *images.measured(view.pair, camera), view.pose.area(board, rays, margin)
