"""Images from a moving robot as an import: pair, choose, find walls, write a frame a wall.

A hand-eye transform makes the planes of right images and poses coincide to within the camera's
error. Wrong ones leave them decimetres apart; then the usual mistakes are undone one by one, to see
whether one of them explains it.
"""

import math
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from tofcorr.data.table import FrameRow
from tofcorr.data.writing import RecordingWriter
from tofcorr.errors import CalibrationDataError
from tofcorr.estimation.moments import Parameters
from tofcorr.geometry import se3
from tofcorr.importing.images import DepthImage
from tofcorr.importing.pose_track import nearest
from tofcorr.importing.robot_images import ImagesOfPlanes, PosedOptions, RobotImages
from tofcorr.importing.run import Frame, PreparedImport, Refused, Sieve, camera_mapping, run_import
from tofcorr.importing.timing import Lag, estimate_lag, far_lags, find_stops, pair, refine_lag
from tofcorr.importing.walls.finding import FoundWalls, walls_of_planes
from tofcorr.importing.walls.hand_eye import distances
from tofcorr.importing.walls.image_planes import ImagePlane, plane_masks, seen_planes
from tofcorr.plausibility.finding import CAMERA, FAR_OFF
from tofcorr.plausibility.mistakes import FAR_BETTER, IN_IMAGES, IN_POSES
from tofcorr.progress import through

_LAG_OF_STOPS = 0.02
"""Seconds before and after an image in which the tool must stand still besides the uncertainty of
the lag: an exposure and the jitter of a time stamp. A refined lag that differs by more from the
first changes which images are at rest."""

_OF_POSES = (
    *("in millimetres", "inverted", "quaternions", "rotations"),
    *("shifted +1", "shifted -1", "shifted +2", "shifted -2"),
)
"""Usual mistakes in poses, the likely ones first. Each costs a search for walls."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Chosen:
    """Images with poses.

    Attributes:
        images: Their numbers in the source, shape (N,), increasing.
        world_from_tool: Shape (N, 4, 4), metres, as the poses' file has them.
        stop: The stop that each belongs to, shape (N,); -1 while moving.
        moving: Images with a pose that were taken while the tool moved, shape (K,).
        refused: Images left out, and why.
        paired_by: `time`, `name` or `order`.
    """

    images: np.ndarray
    world_from_tool: np.ndarray
    stop: np.ndarray
    moving: np.ndarray
    refused: Refused
    paired_by: str


def import_posed(source: RobotImages, out: Path, options: PosedOptions) -> dict[str, Any]:
    """Turn depth images and robot poses into a recording of walls; return its `import.json`.

    Args:
        source: Images and poses.
        out: The recording to write; it must not exist yet.
        options: How to pair, choose and look for walls.

    Raises:
        CalibrationDataError: Images and poses do not belong together, a unit must be wrong, no
            wall is found, or `out` exists or cannot be written.
    """
    prepare = PosedImport(source, options).prepare
    return run_import(source.origin, options, prepare, out)


class PosedImport:
    """Depth images and the poses of the robot, on the way to a recording.

    Args:
        source: Images and poses.
        options: How to pair, choose and look for walls.
        planes: As of `ImagesOfPlanes`, where this import is one of many of a source that grows: no
            mistake is then searched for.
    """

    def __init__(
        self,
        source: RobotImages,
        options: PosedOptions,
        planes: dict[str, list[ImagePlane]] | None = None,
    ) -> None:
        self._source, self._options, self._searches = source, options, planes is None
        self._times = None if source.times is None else source.times + options.time_offset_s
        self._track = source.track
        if options.eye_to_hand:
            inverse = np.linalg.inv(source.track.world_from_tool)
            self._track = replace(source.track, world_from_tool=inverse)
        self._images = ImagesOfPlanes(source, options, planes)

    def prepare(self, sieve: Sieve) -> PreparedImport:
        """Read all images once or twice, and find out everything but the frames themselves."""
        source, options = self._source, self._options
        sieve.refused |= source.refused
        self._readable, change = self._images.look(sieve)
        # How much each readable image differs from the one before, where both have times.
        self._changes = None
        listed = self._track.lists_stops(options.pose_tolerance_s)
        if self._times is not None and self._track.timestamp is not None and not listed:
            self._changes = self._times[self._readable], change[self._readable][1:]
        lag = self._first_lag()
        chosen = self._choose(lag)
        if 1000 * np.ptp(chosen.world_from_tool, axis=0).max() < 1:  # And by a milliradian.
            said = "all poses are the same to a millimetre"
            raise CalibrationDataError(f"{self._track.source}: {said}.")
        found, warnings = self._walls(chosen)
        if lag is not None and options.lag_s == "auto":
            refined = self._refined(lag, chosen.moving, found)
            if options.moving == "keep" or abs(refined.seconds - lag.seconds) > _LAG_OF_STOPS:
                chosen = self._choose(refined)
                found, warnings = self._walls(chosen)
            lag = refined
            warnings = [*_lag_warnings(lag), *warnings]
        sieve.refused |= chosen.refused | found.left_out
        warnings = [*warnings, *(f"{said}; they count once." for said in source.track.repeats)]
        if source.planes is not None:
            found = found.measured(source.planes)
        return PreparedImport(
            views=self._reported(chosen, found),
            frames=self._frames(chosen, found),
            writer=self._writer(found),
            camera=camera_mapping(self._images.camera, source.origin),
            findings={
                "paired_by": chosen.paired_by,
                "stops": len(np.unique(chosen.stop[chosen.stop >= 0])),
                "lag": lag and asdict(lag),
                **found.to_mapping(),
            },
            warnings=[
                *source.warnings,
                *warnings,
                *_contradiction(source.tool_from_camera, found.tool_from_camera),
            ],
        )

    def _first_lag(self) -> Lag | None:
        """Return the lag as given, or estimated from how images and poses change."""
        if self._options.lag_s == "auto":
            return None if self._changes is None else estimate_lag(self._track, *self._changes)
        timed = self._times is not None and self._track.timestamp is not None
        return Lag(seconds=self._options.lag_s) if timed else None

    def _choose(self, lag: Lag | None) -> Chosen:
        """Pair images with poses, and keep those of stops.

        Args:
            lag: Of the images' clock; None: none is known.

        Raises:
            CalibrationDataError: No image is left.
        """
        names, times, track, options = self._source.names, self._times, self._track, self._options
        late, error = (lag.seconds, lag.standard_error) if lag else (0.0, 0.0)
        tolerance = options.pose_tolerance_s
        images, poses, refused, by = pair(names, times, track, tolerance=tolerance, lag=late)
        images, poses = images[self._readable[images]], poses[self._readable[images]]
        if times is None or track.timestamp is None:
            stop = np.arange(len(images))
        elif track.lists_stops(tolerance):
            stop = nearest(track.timestamp, times[images] - late)
        else:
            stop = find_stops(track, times[images] - late, _LAG_OF_STOPS + 2 * error)
        moving = images[stop < 0]
        take = (stop < 0) & (options.moving == "keep")
        refused |= {names[int(k)]: "the tool was moving" for k in images[(stop < 0) & ~take]}
        # At most so many images of a stop, evenly spread, the middle first.
        for number in np.unique(stop[stop >= 0]):
            own = np.flatnonzero(stop == number)
            count = min(options.images_per_stop, len(own))
            take[own[((np.arange(count) + 0.5) * len(own) / count).astype(int)]] = True
        reason = f"its stop has {options.images_per_stop} images already"
        refused |= {names[int(k)]: reason for k in images[(stop >= 0) & ~take]}
        if not take.any():
            raise CalibrationDataError(f"{track.source}: the tool always moves. Add --keep-moving?")
        return Chosen(
            images=images[take],
            world_from_tool=poses[take],
            stop=stop[take],
            moving=moving,
            refused=refused,
            paired_by=by,
        )

    def _walls(self, chosen: Chosen) -> tuple[FoundWalls, list[str]]:
        """Find walls, and say where they do not fit; refuse what a mistake explains."""
        numbers = through(chosen.images.tolist(), "finding walls", "view")
        planes = [self._images.planes(k) for k in numbers]
        try:
            found = self._walls_of(planes, chosen.images, chosen.world_from_tool)
        except CalibrationDataError:
            self._explained(chosen, None)
            raise
        return found, self._explained(chosen, found)

    def _walls_of(
        self, planes: list[list[ImagePlane]], images: np.ndarray, poses: np.ndarray
    ) -> FoundWalls:
        source, camera = self._source, self._images.camera
        return walls_of_planes(
            planes,
            [source.names[int(k)] for k in images],
            camera.width * camera.height,
            poses,
            self._options.walls,
            origin=source.origin,
            targets=None if source.targets is None else source.targets[images],
        )

    def _explained(self, chosen: Chosen, given: FoundWalls | None) -> list[str]:
        """Name the mistake that explains why planes do not coincide.

        Args:
            chosen: The images used, with poses.
            given: The walls of images and poses as given; None: none were found.

        Returns:
            A sentence that says that no mistake explains it; none if the walls are as good as can
            be expected, there are none, or their names are given.

        Raises:
            CalibrationDataError: A mistake explains it; the message names it, and both misfits.
        """
        origin, most = self._source.origin, FoundWalls.SUSPICIOUS_MM
        before = FoundWalls.OFF_WALL_MM if given is None else given.misfit_mm
        if before <= most or self._source.targets is not None or not self._searches:
            return []
        left = {}
        for said, misfit, unit in self._mistakes_undone(chosen):
            # Distances that are shorter have smaller misfits: what counts is their share of them.
            left[said] = misfit / (1 if given is None else unit), misfit
            if left[said][0] <= FAR_BETTER * most:
                break
        best = min(left, key=left.__getitem__)
        if left[best][0] <= FAR_BETTER * before:
            said = f"{origin}: Walls are off by {before:.0f} mm as given"
            raise CalibrationDataError(f"{said}, and by {left[best][1]:.0f} mm if {best}")
        if given is None:
            return []
        seeing = f"{len(np.unique(given.image))} of {len(chosen.images)} images show a wall"
        off = f"planes are off by {before:.0f} mm, up to {most:.0f} are expected"
        return [f"{seeing}, and {off}. Do images and poses belong together?"]

    def _mistakes_undone(self, chosen: Chosen) -> Iterator[tuple[str, float, float]]:
        """Yield each usual mistake, with advice, the misfit that it leaves when undone, its factor.

        The factor, 1 at most, is by how much distances are shorter then.

        A unit is not tried in which the tool moves less, or the camera sees less far, than errors
        of a camera: any planes then coincide.
        """
        listed = [IN_POSES[name] for name in _OF_POSES]
        for cause, advice, undo in listed if self._changes is None else listed[:4]:
            if np.ptp(undo(chosen.world_from_tool)[:, :3, 3], axis=0).max() >= CAMERA:
                yield f"{cause}: {advice}.", self._misfit(chosen, undo), 1.0
        cause, advice, mirrored = IN_IMAGES["mirrored left to right"]
        yield f"{cause}: {advice}.", self._misfit(chosen, depth=mirrored), 1.0
        first = self._images.read(int(chosen.images[0])).depth
        for factor in (1 / 1000, 1 / 10, 10, 1000):
            said = f"all distances are multiplied by {factor:g}: is --depth-unit-mm right?"
            if factor * np.ma.median(np.ma.masked_invalid(first)) >= FAR_OFF:
                left = self._misfit(chosen, depth=lambda metres, k=factor: k * metres)
                yield said, left, min(factor, 1.0)
        for late in far_lags(self._track, *self._changes) if self._changes else ():
            said = f"images are {abs(late):.1f} s {'late' if late > 0 else 'early'}"
            with suppress(CalibrationDataError):
                left = self._misfit(self._choose(Lag(seconds=late)))
                yield f"{said}: add --time-offset-s {-late:.1f}.", left, 1.0

    def _misfit(
        self,
        used: Chosen,
        poses: Callable[[np.ndarray], np.ndarray] = np.asarray,
        depth: Callable[[np.ndarray], np.ndarray] | None = None,
    ) -> float:
        """Return the misfit of 30 images with a mistake undone: enough for every wall of a room."""
        few = np.unique(np.linspace(0, len(used.images) - 1, 30).round().astype(int))

        def planes(k: int) -> list[ImagePlane]:
            if depth is None:
                return self._images.planes(k)
            undone = np.ascontiguousarray(depth(self._images.read(k).depth))
            return self._images.planes_in(DepthImage(undone))

        images, undone_poses = used.images[few], poses(used.world_from_tool)[few]
        seen = [planes(k) for k in images.tolist()]
        try:
            return self._walls_of(seen, images, undone_poses).misfit_mm
        except CalibrationDataError:
            return FoundWalls.OFF_WALL_MM

    def _refined(self, lag: Lag, moving: np.ndarray, found: FoundWalls) -> Lag:
        """Refine the lag on images that were taken while the tool moved, 200 of them.

        At 0.1 m/s and 10 mm a plane, the mean of 200 tells 1 to 2 ms, a fifth of what matters.
        """
        assert self._times is not None
        some = moving[:: max(1, -(-len(moving) // 200))]
        planes = [
            self._images.planes(k) for k in through(some.tolist(), "refining the lag", "view")
        ]
        if sum(map(len, planes)) < 10:
            return lag
        times, walls = self._times[some], torch.from_numpy(found.walls)
        # With the error found at stops: else a constant, before one wall, would look like a lag.
        hand_eye, error = torch.from_numpy(found.tool_from_camera), torch.from_numpy(found.error)
        fitted = Parameters(hand_eye, error)
        seen = seen_planes(planes, torch.from_numpy(self._track.at(times)), 1)

        def losses(late: float) -> np.ndarray:
            pose = torch.from_numpy(self._track.at(times - late))
            moved = replace(seen, world_from_tool=pose[seen.image])
            off = distances(*moved.in_world(fitted), walls).min(dim=1).values
            # In units of 10 mm: the error of a camera that is not calibrated yet. A tool at 1 m/s
            # is off by 0.1 m after 0.1 s of lag: what is farther is on no wall.
            return (100 * off.clamp(max=1 / 10)).square().log1p().numpy()

        return refine_lag(losses, lag)

    def _writer(self, found: FoundWalls) -> partial[RecordingWriter]:
        """Begin the recording, with the names of frames as its format has them.

        Where the robot carries the target, its tool is the recording's world, and its base carries
        the camera.
        """
        options, known, names = self._options, self._source.tool_from_camera, self._options.frames
        if options.eye_to_hand:
            exchanged = {"world": names.tool, "tool": names.world, "eye_to_hand": True}
            names = names.model_copy(update=exchanged)
        return partial(
            RecordingWriter,
            camera=self._images.camera,
            depth_kind=options.depth_kind,
            modulation_frequency=options.modulation_frequency_hz,
            saturation_amplitude=options.saturation_amplitude,
            tool_from_camera=found.tool_from_camera if known is None else known,
            planes="estimated" if self._source.planes is None else "recorded",
            frame_names=names,
        )

    def _reported(self, chosen: Chosen, found: FoundWalls) -> list[dict[str, Any]]:
        """Return what `import.json` says of each frame: one image of one wall."""
        times = [None] * len(self._source.names) if self._times is None else self._times.tolist()
        return [
            {
                "view": self._source.names[int(chosen.images[image])],
                "wall": found.names[wall],
                "stop": int(chosen.stop[image]),
                "timestamp_s": times[chosen.images[image]],
            }
            for image, wall in zip(found.image, found.wall, strict=True)
        ]

    def _frames(self, chosen: Chosen, found: FoundWalls) -> Iterator[Frame]:
        """Yield one frame for each image and wall."""
        for place in np.unique(found.image).tolist():
            own, number = found.image == place, int(chosen.images[place])
            image, stop = self._images.read(number), int(chosen.stop[place])
            distance, valid = self._images.along_rays(image)
            masks = valid.expand(int(own.sum()), *valid.shape)
            if found.gradient is not None:
                gradients = torch.from_numpy(found.gradient[own])
                tolerance = self._options.walls.tolerance_mm / 1000
                masks = plane_masks(distance, valid, self._images.rays, gradients, tolerance)
            timestamp = float(place)
            if self._times is not None:
                timestamp = float(self._times[number] - self._times[chosen.images[0]])
            for wall, mask in zip(found.wall[own], masks.numpy(), strict=True):
                row = FrameRow(
                    timestamp=timestamp,
                    world_from_tool=chosen.world_from_tool[place],
                    normal_world=found.walls[wall, :3],
                    offset=float(found.walls[wall, 3]),
                    target=found.names[wall],
                    pose_id=f"stop {stop}" if stop >= 0 else f"image {number}",
                )
                yield row, image.depth, image.amplitude, mask


def _lag_warnings(lag: Lag) -> list[str]:
    """Return a sentence about an estimated lag that is not zero.

    It is named from three standard errors on, and from 5 ms: at 0.2 m/s that is 1 mm.
    """
    if abs(lag.seconds) < max(3 * lag.standard_error, _LAG_OF_STOPS / 4):
        return []
    when = "late" if lag.seconds > 0 else "early"
    size = f"{1000 * abs(lag.seconds):.0f} ± {2000 * lag.standard_error:.0f} ms {when}"
    return [f"Images are stamped {size} against the poses; --lag-s 0 does not remove this lag."]


def _contradiction(known: np.ndarray | None, found: np.ndarray) -> list[str]:
    """Return a sentence if the walls contradict a known hand-eye transform; else nothing.

    It is doubted from 50 mm and 3 degrees on: a few times what an uncalibrated camera's error moves
    the estimate.

    Args:
        known: tool_from_camera as the source states it, shape (4, 4); None: it does not.
        found: tool_from_camera under which the walls fit best, shape (4, 4).
    """
    if known is None:
        return []
    shift, turn = se3.apart(torch.as_tensor(known), torch.as_tensor(found))
    if 1000 * shift < 50 and math.degrees(turn) < 3:
        return []
    away = f"{1000 * shift:.0f} mm and {math.degrees(turn):.1f} degrees away from its poses"
    return [f"The walls fit best with the camera {away}. Are they those of the depth camera?"]
