"""Images from a moving robot as an import: pair, choose, find walls, write a frame a wall."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tofcorr.data.header import FrameNames
from tofcorr.data.table import FrameRow
from tofcorr.data.writing import RecordingWriter
from tofcorr.errors import CalibrationDataError
from tofcorr.geometry.rays import ray_directions
from tofcorr.importing.engine import ImportedFrame, PreparedImport, camera_mapping, run_import
from tofcorr.importing.posed.chosen import Chosen, choose
from tofcorr.importing.posed.first_look import FirstLook, look
from tofcorr.importing.posed.lag_refinement import refine_lag
from tofcorr.importing.posed.options import PosedOptions
from tofcorr.importing.posed.units import refuse_impossible_depth, refuse_impossible_poses
from tofcorr.importing.poses.track import PoseTrack
from tofcorr.importing.report import ImportedView, ImportReport, Refusal, RefusedViewError
from tofcorr.importing.sieve import Progress, Sieve, no_progress
from tofcorr.importing.source import DepthImage, DepthSource
from tofcorr.importing.timing.lag import Lag, estimate_lag
from tofcorr.importing.walls.finding import PosedImages, find_walls_in
from tofcorr.importing.walls.found import FoundWalls, WallView
from tofcorr.importing.walls.image_planes import find_planes, plane_masks

_MOST_MOVING = 200
"""Images taken in motion that refine the lag: at 0.1 m/s and 10 mm a plane their mean tells a
millisecond or two, ten times less than what matters."""

_SEED = 0


@dataclass(frozen=True, kw_only=True)
class WallFrame(ImportedView):
    """One frame of the recording: one image of one wall.

    Attributes:
        wall: The wall's name.
        stop: Number of the stop; -1 while moving.
        timestamp_s: Of the image, on its own clock; None without time stamps.
    """

    wall: str
    stop: int
    timestamp_s: float | None


def import_posed(
    source: DepthSource,
    track: PoseTrack,
    out: Path,
    options: PosedOptions,
    *,
    refused: list[Refusal] | None = None,
    targets: np.ndarray | None = None,
    progress: Progress = no_progress,
) -> ImportReport:
    """Turn depth images and robot poses into a recording of walls.

    Args:
        source: The images.
        track: Poses of the tool in the robot's base.
        out: The recording to write; it must not exist yet.
        options: How to pair, choose and look for walls.
        refused: Images that the source has left out already.
        targets: Which wall each image shows, shape (I,), text; None: walls are looked for.
        progress: Shows how far a step has come.

    Raises:
        CalibrationDataError: Images and poses do not belong together, a unit must be wrong, no
            wall is found, or `out` exists or cannot be written.
    """
    images = RobotImages(source, track, options, refused or [], targets)
    return run_import(images, out, progress)


class RobotImages:
    """Depth images and the poses of the robot; a `tofcorr.importing.engine.ImageSource`."""

    def __init__(
        self,
        source: DepthSource,
        track: PoseTrack,
        options: PosedOptions,
        refused: list[Refusal],
        targets: np.ndarray | None = None,
    ) -> None:
        self.folder = Path(source.origin)
        self.options = options
        self._source = source
        self._times = None if source.times is None else source.times + options.time_offset_s
        self._track = _carrying_the_camera(track) if options.eye_to_hand else track
        self._refused = refused
        self._targets = targets
        self._rays = ray_directions(source.camera)
        self._last: tuple[int, DepthImage] | None = None

    def prepare(self, sieve: Sieve) -> PreparedImport:
        """Read all images once or twice, and find out everything but the frames themselves."""
        source, options = self._source, self.options
        seen = look(source, sieve.progress)
        refuse_impossible_depth(seen.median_depth, source.origin)
        lag = self._first_lag(seen)
        chosen = choose(source.names, self._times, seen.readable, self._track, options, lag)
        sieve.refused += [*self._refused, *seen.refused, *chosen.refused]
        refuse_impossible_poses(chosen.world_from_tool, self._track.source)
        found = self._walls(chosen, sieve)
        if lag is not None and options.lag_s == "auto":
            lag = self._refined(lag, chosen, found, sieve)
            if options.moving == "keep":
                chosen = choose(source.names, self._times, seen.readable, self._track, options, lag)
                found = self._walls(chosen, sieve)
        sieve.refused += [
            replace(one, view=_named(one.view, source.names, chosen)) for one in found.left_out
        ]
        return PreparedImport(
            views=self._views(chosen, found),
            frame=lambda index: self._frame(found.views[index], chosen, found),
            open_writer=lambda path: RecordingWriter(
                path,
                camera=source.camera,
                depth_kind=options.depth_kind,
                modulation_frequency=options.modulation_frequency_hz,
                saturation_amplitude=options.saturation_amplitude,
                tool_from_camera=found.tool_from_camera,
                planes="estimated",
                frame_names=_frame_names(options),
            ),
            camera=camera_mapping(source.camera, source.origin),
            findings={
                "paired_by": chosen.paired_by,
                "stops": len(np.unique(chosen.stop[chosen.stop >= 0])),
                "lag": None if lag is None else _lag_mapping(lag),
                **found.to_mapping(),
            },
            warnings=[*_lag_warnings(lag, options), *found.warnings],
        )

    def _first_lag(self, seen: FirstLook) -> Lag | None:
        """Return the lag as given, or estimated from how images and poses change."""
        if self._times is None or self._track.timestamp is None:
            return None
        if self.options.lag_s != "auto":
            return Lag(seconds=self.options.lag_s, standard_error=0.0, correlation=float("nan"))
        readable = np.flatnonzero(seen.readable)
        return estimate_lag(self._track, self._times[readable], seen.change[readable][1:])

    def _refined(self, lag: Lag, chosen: Chosen, found: FoundWalls, sieve: Sieve) -> Lag:
        """Refine the lag on the planes of images that were taken in motion."""
        assert self._times is not None
        step = -(-len(chosen.moving) // _MOST_MOVING) if len(chosen.moving) else 1
        times, points, walls = [], [], []
        in_camera = _walls_by_name(found)
        for k in sieve.progress(chosen.moving[::step].tolist(), "refining the lag"):
            pose = self._track.at(self._times[k : k + 1] - lag.seconds)[0]
            if not np.isfinite(pose).all():
                continue
            for plane in self._planes(k):
                wall = _nearest_wall(plane.points, plane.normal, pose, found, in_camera)
                if wall is not None:
                    times.append(self._times[k])
                    points.append(plane.points)
                    walls.append(wall)
        if not times:
            return lag
        normal, offset = in_camera
        chosen_walls = torch.tensor(walls)
        return refine_lag(
            self._track,
            np.array(times),
            torch.stack(points),
            normal[chosen_walls],
            offset[chosen_walls],
            found.tool_from_camera,
            lag,
        )

    def _walls(self, chosen: Chosen, sieve: Sieve) -> FoundWalls:
        posed = PosedImages(
            origin=self._source.origin,
            camera=self._source.camera,
            world_from_tool=chosen.world_from_tool,
            images=self._radial_images(chosen, sieve),
            targets=None if self._targets is None else self._targets[chosen.images],
        )
        return find_walls_in(posed, np.eye(4), self.options.walls)

    def _radial_images(self, chosen: Chosen, sieve: Sieve) -> Iterator[tuple[Tensor, Tensor]]:
        for k in sieve.progress(chosen.images.tolist(), "finding walls"):
            yield self._radial(self._read(k))

    def _planes(self, number: int) -> list[Any]:
        distance, valid = self._radial(self._read(number))
        generator = torch.Generator().manual_seed(_SEED)
        return find_planes(distance, valid, self._rays, self.options.walls, generator)

    def _radial(self, image: DepthImage) -> tuple[Tensor, Tensor]:
        """Return distances along the ray, and where they are usable."""
        depth = torch.from_numpy(image.depth).double()
        distance = depth / self._rays[..., 2] if self.options.depth_kind == "z" else depth
        valid = distance.isfinite() & (distance > 0)
        saturated = self.options.saturation_amplitude
        if saturated is not None and image.amplitude is not None:
            valid &= torch.from_numpy(image.amplitude) < saturated
        return distance.nan_to_num(0.0), valid

    def _read(self, number: int) -> DepthImage:
        """Read an image; the last one read is kept, since each of its walls asks for it."""
        if self._last is None or self._last[0] != number:
            try:
                self._last = (number, self._source.read(number))
            except RefusedViewError as refusal:
                raise CalibrationDataError(
                    f"{self._source.origin}: {refusal}; it could be read a moment ago. Were the "
                    "files changed?"
                ) from None
        return self._last[1]

    def _views(self, chosen: Chosen, found: FoundWalls) -> list[WallFrame]:
        return [
            WallFrame(
                frame=index,
                view=self._source.names[chosen.images[view.image]],
                wall=found.walls[view.wall].name,
                stop=int(chosen.stop[view.image]),
                timestamp_s=None
                if self._times is None
                else float(self._times[chosen.images[view.image]]),
            )
            for index, view in enumerate(found.views)
        ]

    def _frame(self, view: WallView, chosen: Chosen, found: FoundWalls) -> ImportedFrame:
        number = int(chosen.images[view.image])
        image = self._read(number)
        distance, valid = self._radial(image)
        mask = valid.numpy()
        if view.gradient is not None:
            own = [v for v in found.views if v.image == view.image]
            gradients = torch.from_numpy(
                np.stack([v.gradient for v in own if v.gradient is not None])
            )
            tolerance = 1e-3 * self.options.walls.tolerance_mm
            masks = plane_masks(distance, valid, self._rays, gradients, tolerance)
            mask = masks[own.index(view)].numpy()
        wall = found.walls[view.wall]
        stop = int(chosen.stop[view.image])
        first = 0.0 if self._times is None else float(self._times[chosen.images[0]])
        row = FrameRow(
            timestamp=float(view.image) if self._times is None else self._times[number] - first,
            world_from_tool=chosen.world_from_tool[view.image],
            normal_world=wall.normal_world,
            offset=wall.offset,
            target=wall.name,
            pose_id=f"stop {stop}" if stop >= 0 else f"image {number}",
        )
        return ImportedFrame(row=row, depth=image.depth, amplitude=image.amplitude, mask=mask)


def _carrying_the_camera(track: PoseTrack) -> PoseTrack:
    """Return poses of the base in the tool: the camera is on the base, the target on the tool."""
    poses = track.world_from_tool
    inverse = np.tile(np.eye(4), (len(poses), 1, 1))
    inverse[:, :3, :3] = poses[:, :3, :3].transpose(0, 2, 1)
    inverse[:, :3, 3] = -np.einsum("nij,nj->ni", inverse[:, :3, :3], poses[:, :3, 3])
    return replace(track, world_from_tool=inverse)


def _frame_names(options: PosedOptions) -> FrameNames:
    """Return the names as the recording format has them (the tool carries the target: swapped)."""
    names = options.frames
    if not options.eye_to_hand:
        return names
    return names.model_copy(update={"world": names.tool, "tool": names.world})


def _walls_by_name(found: FoundWalls) -> tuple[Tensor, Tensor]:
    normal = torch.from_numpy(np.stack([wall.normal_world for wall in found.walls]))
    return normal, torch.tensor([wall.offset for wall in found.walls], dtype=torch.float64)


def _nearest_wall(
    points: Tensor,
    normal: Tensor,
    world_from_tool: np.ndarray,
    found: FoundWalls,
    walls: tuple[Tensor, Tensor],
) -> int | None:
    """Return the wall that a plane lies on within 0.1 m and 12 degrees; None: on none."""
    pose = torch.from_numpy(world_from_tool @ found.tool_from_camera)
    there = points @ pose[:3, :3].T + pose[:3, 3]
    off = (there @ walls[0].T + walls[1]).square().mean(dim=0).sqrt()
    facing = walls[0] @ (pose[:3, :3] @ normal)
    off = torch.where(facing > np.cos(np.radians(12.0)), off, torch.inf)
    nearest = int(off.argmin())
    return nearest if float(off[nearest]) < 0.1 else None


def _named(view: str, names: Any, chosen: Chosen) -> str:  # noqa: ANN401 - a sequence of names
    """Replace the number in 'image 3, plane 2' by the image's name."""
    head, comma, tail = view.partition(",")
    number = int(head.split()[1])
    return f"{names[chosen.images[number]]}{comma}{tail}"


def _lag_mapping(lag: Lag) -> dict[str, float | None]:
    correlation = None if np.isnan(lag.correlation) else round(lag.correlation, 3)
    return {
        "seconds": round(lag.seconds, 5),
        "standard_error": round(lag.standard_error, 5),
        "correlation": correlation,
    }


def _lag_warnings(lag: Lag | None, options: PosedOptions) -> list[str]:
    if lag is None or options.lag_s != "auto":
        return []
    if abs(lag.seconds) < max(3 * lag.standard_error, 0.005):
        return []
    return [
        f"Images are stamped {1e3 * lag.seconds:.0f} ± {2e3 * lag.standard_error:.0f} ms later "
        "than they were taken on the clock of the poses; this lag was removed. Add --lag-s 0 to "
        "keep the stamps as they are."
    ]
