"""Import of depth images of a board, with the image that shows its corners beside each.

What the board says of measured depth is compared too: wrong units, mixed-up images, and what a
board cannot tell apart. Only gross disagreement is refused (a tenth of the distance, tens of
degrees). Errors of millimetres and centimetres are what the recording is made for; they are kept.
All limits were set by hand, far beyond the errors of a working camera; on the 102 views of the
Kinect v2 in `tests/importing/checkerboard/test_kinect2.py` they refuse at most 4.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import torch
from pydantic import Field

from tofcorr.data.recording import DepthKind
from tofcorr.data.table import FrameRow
from tofcorr.data.writing import RecordingWriter
from tofcorr.errors import CalibrationDataError
from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.geometry.rays import ray_directions
from tofcorr.importing.checkerboard.boards import (
    AnyBoard,
    BoardPose,
    calibrate,
    calibration_warning,
    estimate_pose,
)
from tofcorr.importing.images import (
    DepthCoding,
    DepthImage,
    files_of_views,
    of_size,
    read_depth,
    read_grey,
    times_in_names,
    turned,
)
from tofcorr.importing.intrinsics import GivenIntrinsics
from tofcorr.importing.pose_files import read_poses
from tofcorr.importing.robot_images import PosedOptions
from tofcorr.importing.run import (
    Frame,
    PreparedImport,
    Refused,
    RefusedViewError,
    Sieve,
    camera_mapping,
    run_import,
)
from tofcorr.importing.timing import pair
from tofcorr.importing.walls.finding import FoundWalls, walls_of_planes
from tofcorr.importing.walls.image_planes import WallOptions, described
from tofcorr.options import Options, PositiveNumber

_FEWEST_PIXELS = 50
"""Fewest board pixels with depth; a fifth of all board pixels must have it, too."""

_LARGEST_TILT_DEG = 25.0
"""Largest angle between the plane of the depth image and the board's pose, degrees: boards taken
for one another, or mirrored, differ by more."""

_TENTH = 0.1
"""Share of the distance: 0.1 m at 1 m is beyond any camera's error, and mixed-up images exceed it.
From half of it on all views together get a warning: 5 cm at 1 m is the largest error that an
uncalibrated camera is known for."""

# With a longer focal length the board seems farther away, its corners at almost the same pixels;
# with longer squares at exactly the same.
_DEGENERACY = (
    "A board cannot tell focal length, square length and slope of the distance error apart: a "
    "focal length or squares 1 % longer lower the slope by 10 mm/m. Measure the printed board, and "
    "take the focal length from a source of its own, before trusting offset and slope."
)

_SAME_VIEW = "are the two images of the same view?"


class CheckerboardOptions(Options):
    """How to read a folder of checkerboard images.

    Attributes:
        depth_pattern: Names of the depth images, with `{view}` or wildcards.
        infrared_pattern: Names of the infrared images, in which the boards are found.
        amplitude_pattern: Names of the amplitude images; None: there are none.
        board: The board that they show.
        coding: How the numbers of the depth images are to be read.
        depth_kind: `z`: along the optical axis; `radial`: along the ray.
        saturation_counts: Infrared counts from which a pixel is saturated; None: never.
        margin_squares: How far the mask extends beyond the outermost inner corners, in squares. Up
            to 0 the corners surround every pixel used; 1 is the outer edge of the squares.
        max_reprojection_px: Views with a larger reprojection error (root mean square) are refused.
        modulation_frequency: Modulation frequency of the camera, Hz; None if unknown.
        poses: File of the poses of the robot that carries the camera; None: there is none.
    """

    depth_pattern: str = "{view}_depth.png"
    infrared_pattern: str = "{view}_ir.png"
    amplitude_pattern: str | None = "{view}_ir.png"
    board: AnyBoard
    coding: DepthCoding = DepthCoding(invalid=())
    depth_kind: DepthKind = "z"
    saturation_counts: PositiveNumber | None = 65535.0
    margin_squares: Annotated[float, Field(gt=-1.0, le=2.0)] = 0.0
    max_reprojection_px: PositiveNumber = 0.5
    modulation_frequency: PositiveNumber | None = None
    poses: Path | None = None


class BoardView(NamedTuple):
    """A view whose board has a pose: measured depth against it.

    Attributes:
        pose: The board in the camera frame.
        ratio: Median of measured over true distance.
        kind_moments: Sum over pixels of v v', shape (4, 4), metres, with v = (1, D, D (1 - cos a),
            measured minus true radial distance) and a the angle to the optical axis.
        reported: What `import.json` says of it. `depth_error_mm` is the median of measured minus
            true depth, of the kind recorded.
    """

    pose: BoardPose
    ratio: float
    kind_moments: np.ndarray
    reported: dict[str, Any]


def import_checkerboard(
    folder: Path, out: Path, options: CheckerboardOptions, intrinsics: GivenIntrinsics | None
) -> dict[str, Any]:
    """Turn images of a board into a recording, with `import.json` beside the arrays.

    Without a robot the world is the camera frame: the plane of each frame comes from the board's
    corners in its own infrared image. With poses of a robot, before a board that stands still, the
    corners of all views give a start of the hand-eye transform and of the one plane. A view that
    cannot be used is left out and listed with its reason.

    Args:
        folder: Where the images are.
        out: The recording to write; it must not exist yet.
        options: How to read the images.
        intrinsics: The camera intrinsics; None: calibrate them from the board.

    Raises:
        CalibrationDataError: No view can be used, the intrinsics do not fit the images, a unit
            must be wrong, or `out` exists or cannot be written.
    """
    prepare = BoardImport(folder, options, intrinsics).prepare
    return run_import(str(folder), options, prepare, out)


class BoardImport:
    """Images of a board on the way to a recording; arguments as of `import_checkerboard`."""

    _camera: CameraIntrinsics
    _rays: np.ndarray

    def __init__(
        self, folder: Path, options: CheckerboardOptions, intrinsics: GivenIntrinsics | None
    ) -> None:
        self._options, self._coding = options, options.coding
        self._intrinsics, self._board = intrinsics, options.board
        patterns = {"depth": options.depth_pattern, "infrared": options.infrared_pattern}
        patterns |= {"amplitude": options.amplitude_pattern} if options.amplitude_pattern else {}
        self._files, self._alone = files_of_views(folder, patterns)
        self._corners: dict[str, np.ndarray] = {}
        self._sizes: dict[str, tuple[int, int]] = {}

    def prepare(self, sieve: Sieve) -> PreparedImport:
        """Find the boards, calibrate the camera if asked to, and place the boards."""
        options = self._options
        sieve.refused |= self._alone
        detect = partial(self._detect, refused=sieve.refused)
        sieve.apply(detect, list(self._files), str, "finding boards")
        about_camera, warnings = self._calibrate()
        self._rays = ray_directions(self._camera).numpy()
        views = sieve.apply(self._place, list(self._corners), str, "placing boards")
        ratio = typical_ratio(views)
        refuse = partial(refuse_mixed_up, ratio=ratio)
        views = sieve.apply(refuse, views, lambda view: view.reported["view"], "comparing boards")
        warnings += agreement_warnings(views, ratio, options.depth_kind)
        views, tool, wall = self._posed(views, sieve.refused)
        return PreparedImport(
            views=[view.reported for view in views],
            frames=self._frames(views, tool, wall),
            writer=partial(
                RecordingWriter,
                tool_from_camera=wall and wall.tool_from_camera,
                planes="estimated" if wall else "recorded",
                camera=self._camera,
                depth_kind=options.depth_kind,
                modulation_frequency=options.modulation_frequency,
                saturation_amplitude=options.saturation_counts,
            ),
            camera=about_camera,
            warnings=[*warnings, _DEGENERACY],
        )

    def _detect(self, view: str, refused: Refused) -> None:
        """Find the board's corners.

        Where the first is not found, one with a row and a column fewer is looked for: a common
        mistake is to count squares instead of inner corners. One hint is enough.
        """
        # A board is looked for longest where there is none: what is no depth is refused before.
        read_depth(self._files[view], self._coding)
        path, board = self._files[view]["infrared"], self._board
        image = turned(read_grey(path), self._coding.rotate)
        corners = board.find(image)
        if corners is None:
            fewer, said = board.fewer(), ""
            if not refused and fewer is not None and fewer.find(image) is not None:
                said = f", but one of {fewer}: count inner corners, not squares"
            what = f"board of {board} inner corners" if fewer else f"board {board}"
            raise RefusedViewError(f"no {what} found in {path.name}{said}")
        self._corners[view], self._sizes[view] = corners, (image.shape[1], image.shape[0])

    def _calibrate(self) -> tuple[dict[str, Any], list[str]]:
        """Find the camera of the commonest size; return what to report of it, and warnings."""
        size, given = Counter(self._sizes.values()).most_common(1)[0][0], self._intrinsics
        if given is not None:
            self._camera = given.camera(size)
            return camera_mapping(self._camera, given.source), []
        corners = [own for view, own in self._corners.items() if self._sizes[view] == size]
        self._camera, found = calibrate(corners, self._board, size)
        about = camera_mapping(self._camera, "calibrated from the boards") | found
        return about, [calibration_warning(self._camera, found)]

    def _posed(
        self, views: list[BoardView], refused: Refused
    ) -> tuple[list[BoardView], np.ndarray, FoundWalls | None]:
        """Return the views that have a pose, world_from_tool (N, 4, 4), and the wall of the board.

        It is found as walls without a board: which way round a symmetric one is seen does not
        matter. Without a robot all views are at the identity, and there is no wall.

        Raises:
            CalibrationDataError: No hand-eye transform puts the boards of all views onto one plane.
        """
        file, names = self._options.poses, [view.reported["view"] for view in views]
        if file is None:
            return views, np.stack([np.eye(4)] * len(views)), None
        track, near = read_poses(file), PosedOptions().pose_tolerance_s
        kept, tool, alone, _ = pair(names, times_in_names(names), track, tolerance=near)
        refused |= alone
        views, rays, planes = [views[k] for k in kept], torch.from_numpy(self._rays), []
        for view in views:
            area, gradient = self._area(view.pose), -np.divide(*view.pose.plane())
            planes.append([described(rays, torch.from_numpy(area), torch.from_numpy(gradient))])
        names = [view.reported["view"] for view in views]
        options, pixels = WallOptions(), rays[..., 0].numel()
        return views, tool, walls_of_planes(planes, names, pixels, tool, options, str(file))

    def _read(self, view: str) -> DepthImage:
        return of_size(read_depth(self._files[view], self._coding), self._camera)

    def _area(self, pose: BoardPose) -> np.ndarray:
        return pose.area(self._board, self._rays, self._options.margin_squares)

    def _place(self, view: str) -> BoardView:
        """Place the board of a view, and compare the depth with its pose.

        Raises:
            RefusedViewError: No pose fits the corners, too few pixels have depth, or the depth has
                another tilt.
        """
        options, corners = self._options, self._corners[view]
        pose = estimate_pose(corners, self._board, self._camera, options.max_reprojection_px)
        depth, amplitude = self._read(view)
        area, usable = self._area(pose), np.isfinite(depth)
        if options.saturation_counts is not None and amplitude is not None:
            usable &= amplitude < options.saturation_counts
        seen = area & usable
        if seen.sum() < max(_FEWEST_PIXELS, area.sum() / 5):
            raise RefusedViewError(f"only {seen.sum()} of {area.sum()} pixels have usable depth")
        rays = self._rays[seen]
        cosine, true = rays[:, 2], pose.distance(rays)
        along = cosine if options.depth_kind == "z" else 1.0
        measured = depth[seen] / along
        errors = measured - true
        # Flying pixels would tilt the plane of the depth.
        near = (measured[:, None] * rays)[np.abs(errors - np.median(errors)) < _TENTH / 2]
        # Noisy depth has no tilt; `refuse_mixed_up` still checks the ratio.
        if len(near) >= _FEWEST_PIXELS:
            normal = np.linalg.svd(near - near.mean(axis=0), full_matrices=False)[2][2]
            tilt = float(np.degrees(np.arccos(min(abs(float(normal @ pose.plane()[0])), 1.0))))
            if tilt > _LARGEST_TILT_DEG:
                raise RefusedViewError(f"depth is {tilt:.0f} degrees off the board; {_SAME_VIEW}")
        columns = np.stack([np.ones_like(true), true, true * (1.0 - cosine), errors])
        reported = {
            "view": view,
            "reprojection_rms_px": pose.reprojection_rms,
            "corners_used": int(pose.used.sum()),
            "board_pixels": int(area.sum()),
            "usable_pixels": int(seen.sum()),
            "distance_m": float(np.median(true)),
            "depth_error_mm": 1000 * float(np.median(errors * along)),
        }
        return BoardView(pose, float(np.median(measured / true)), columns @ columns.T, reported)

    def _frames(
        self, views: Sequence[BoardView], tool: np.ndarray, wall: FoundWalls | None
    ) -> Iterator[Frame]:
        for index, view in enumerate(views):
            # A wall that is found is a start for the fit: its covariance is not known.
            plane = np.append(*view.pose.plane()) if wall is None else wall.walls[0]
            row = FrameRow(
                timestamp=float(index),  # The files do not say when an image was taken.
                world_from_tool=tool[index],
                normal_world=plane[:3],
                offset=float(plane[3]),
                target=self._board.kind,
                plane_covariance=None if wall else view.pose.plane_covariance,
            )
            depth, amplitude = self._read(view.reported["view"])
            yield row, depth, amplitude, self._area(view.pose)


def typical_ratio(views: Sequence[BoardView]) -> float:
    """Return the median ratio of measured to true distance.

    Raises:
        CalibrationDataError: It is so far from 1 that a unit must be wrong: units differ by factors
            of 10 and more, cameras by a tenth.
    """
    ratio = float(np.median([view.ratio for view in views]))
    if not 0.5 < ratio < 2:
        said = f"depth is {ratio:.3g} times the board's distance"
        raise CalibrationDataError(f"{said}; correct its unit or the square.")
    return ratio


def refuse_mixed_up(view: BoardView, ratio: float) -> BoardView:
    """Return a view, unless its ratio of measured to true distance differs much from that of all.

    Raises:
        RefusedViewError: Depth and infrared image are not of the same view, or the pose is wrong.
    """
    if abs(view.ratio / ratio - 1.0) > _TENTH:
        said = f"the depth is {view.ratio:.3f} times the distance, elsewhere {ratio:.3f}"
        raise RefusedViewError(f"{said}; {_SAME_VIEW}")
    return view


def agreement_warnings(
    views: Sequence[BoardView], ratio: float, depth_kind: DepthKind
) -> list[str]:
    """Return warnings about the unit and the kind of depth.

    The radial error is regressed on D (1 - cosine), with a constant and D as further regressors:
    radial depth declared as z gives a slope of +1, z depth declared as radial gives -1.
    """
    warnings = []
    if abs(ratio - 1.0) > _TENTH / 2:
        off = f"Depth reads {100 * (ratio - 1):+.1f} % against the board"
        warnings.append(f"{off}: are square length, focal length and the unit of depth right?")
    moments = np.sum([view.kind_moments for view in views], axis=0)
    # After removing constant and D, D (1 - cosine) must vary by more than the camera's own error,
    # some millimetres, to estimate its slope.
    explained = moments[2, :2] @ np.linalg.pinv(moments[:2, :2]) @ moments[:2, 2]
    spread_mm = 1000 * np.sqrt(max(moments[2, 2] - explained, 0.0) / moments[0, 0])
    if spread_mm < 5:
        return warnings
    slope = float(np.linalg.solve(moments[:3, :3], moments[:3, 3])[2])
    if abs(slope) > 0.5:
        said = f"the depth error grows with {slope:+.2f} of what turns z into radial depth"
        warnings.append(f"Off the centre {said} (0 expected): is depth really '{depth_kind}'?")
    return warnings
