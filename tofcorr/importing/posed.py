"""Images from a moving robot as an import: pair, choose, find walls, write a frame a wall."""

import math
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from tofcorr.data.table import FrameRow
from tofcorr.data.writing import RecordingWriter
from tofcorr.errors import CalibrationDataError
from tofcorr.geometry import se3
from tofcorr.importing.mistakes import (
    explain_misfit,
    refuse_impossible_depth,
    refuse_impossible_poses,
)
from tofcorr.importing.robot_images import (
    Chosen,
    ImagesOfPlanes,
    PosedOptions,
    RobotImages,
    choose,
    look,
)
from tofcorr.importing.run import (
    Frame,
    PreparedImport,
    Progress,
    Sieve,
    camera_mapping,
    no_progress,
    run_import,
)
from tofcorr.importing.timing import Lag, estimate_lag, far_lags, refine_lag
from tofcorr.importing.walls.finding import FoundWalls, walls_of_planes
from tofcorr.importing.walls.hand_eye import distances, exact
from tofcorr.importing.walls.image_planes import plane_masks, seen_planes

_LAG_OF_STOPS = 0.02
"""A refined lag that differs by more than this from the first (seconds) changes which images are
at rest: the margin that stops are given."""


def import_posed(
    source: RobotImages, out: Path, options: PosedOptions, progress: Progress = no_progress
) -> dict[str, Any]:
    """Turn depth images and robot poses into a recording of walls; return its `import.json`.

    Args:
        source: Images and poses.
        out: The recording to write; it must not exist yet.
        options: How to pair, choose and look for walls.
        progress: Shows how far a step has come.

    Raises:
        CalibrationDataError: Images and poses do not belong together, a unit must be wrong, no
            wall is found, or `out` exists or cannot be written.
    """
    prepare = PosedImport(source, options).prepare
    return run_import(source.origin, options, prepare, out, progress)


class PosedImport:
    """Depth images and the poses of the robot, on the way to a recording.

    Args:
        source: Images and poses.
        options: How to pair, choose and look for walls.
    """

    def __init__(self, source: RobotImages, options: PosedOptions) -> None:
        self._source, self._options = source, options
        self._times = None if source.times is None else source.times + options.time_offset_s
        self._track = source.track.inverse() if options.eye_to_hand else source.track
        self._images = ImagesOfPlanes(source, options)

    def prepare(self, sieve: Sieve) -> PreparedImport:
        """Read all images once or twice, and find out everything but the frames themselves."""
        source, options = self._source, self._options
        sieve.refused |= source.refused
        self._readable, median, change = look(source, sieve)
        refuse_impossible_depth(median, source.origin)
        # How much each readable image differs from the one before, where both have times.
        self._changes = None
        listed = self._track.lists_stops(options.pose_tolerance_s)
        if self._times is not None and self._track.timestamp is not None and not listed:
            self._changes = self._times[self._readable], change[self._readable][1:]
        lag = self._first_lag()
        chosen = self._choose(lag)
        refuse_impossible_poses(chosen.world_from_tool, self._track.source)
        found, warnings = self._walls(chosen, sieve)
        if lag is not None and options.lag_s == "auto":
            refined = self._refined(lag, chosen.moving, found, sieve)
            if options.moving == "keep" or abs(refined.seconds - lag.seconds) > _LAG_OF_STOPS:
                chosen = self._choose(refined)
                found, warnings = self._walls(chosen, sieve)
            lag = refined
            warnings = [*_lag_warnings(lag), *warnings]
        sieve.refused |= chosen.refused | found.left_out
        return PreparedImport(
            views=self._reported(chosen, found),
            frames=self._frames(chosen, found),
            writer=self._writer(found),
            camera=camera_mapping(source.camera, source.origin),
            findings={
                "paired_by": chosen.paired_by,
                "stops": len(np.unique(chosen.stop[chosen.stop >= 0])),
                "lag": None if lag is None else lag.to_mapping(),
                **found.to_mapping(),
            },
            warnings=[
                *source.warnings,
                *warnings,
                *_contradiction(source.tool_from_camera, found.tool_from_camera),
                *found.warnings(),
            ],
        )

    def _first_lag(self) -> Lag | None:
        """Return the lag as given, or estimated from how images and poses change."""
        if self._options.lag_s == "auto":
            return None if self._changes is None else estimate_lag(self._track, *self._changes)
        timed = self._times is not None and self._track.timestamp is not None
        return Lag(seconds=self._options.lag_s) if timed else None

    def _choose(self, lag: Lag | None) -> Chosen:
        names = self._source.names
        return choose(names, self._times, self._readable, self._track, self._options, lag)

    def _walls(self, chosen: Chosen, sieve: Sieve) -> tuple[FoundWalls, list[str]]:
        """Find walls, and a sentence about a mistake that would explain why they do not fit."""
        source, options = self._source, self._options.walls
        numbers = sieve.progress(chosen.images.tolist(), "finding walls")
        planes = [self._images.planes(k) for k in numbers]
        names = [source.names[int(k)] for k in chosen.images]
        targets = None if source.targets is None else source.targets[chosen.images]

        def explain(given: FoundWalls | None) -> list[str]:
            """Refuse what a mistake explains; where planes are named, there is none to undo."""
            if targets is not None:
                return []
            return explain_misfit(
                self._images,
                chosen,
                given,
                options,
                lists=self._changes is None,
                far_lags=lambda: far_lags(self._track, *self._changes) if self._changes else [],
                at_lag=lambda late: self._choose(Lag(seconds=late)),
            )

        try:
            pixels, poses = source.camera.width * source.camera.height, chosen.world_from_tool
            found = walls_of_planes(planes, names, pixels, poses, options, source.origin, targets)
        except CalibrationDataError:
            explain(None)
            raise
        return found, explain(found)

    def _refined(
        self, lag: Lag, moving: np.ndarray, found: FoundWalls, sieve: Sieve, most: int = 200
    ) -> Lag:
        """Refine the lag on images that were taken while the tool moved, `most` of them.

        At 0.1 m/s and 10 mm a plane, the mean of 200 tells 1 to 2 ms, a fifth of what matters.
        """
        assert self._times is not None
        hand_eye, walls = torch.from_numpy(found.tool_from_camera), torch.from_numpy(found.walls)
        times, points, on = [], [], []
        step = max(1, -(-len(moving) // most))
        for k in sieve.progress(moving[::step].tolist(), "refining the lag"):
            pose = torch.from_numpy(self._track.at(self._times[k : k + 1] - lag.seconds))
            if not bool(pose.isfinite().all()) or not self._images.planes(k):
                continue
            seen = seen_planes([self._images.planes(k)], pose, 1)
            off, nearest = distances(*seen.in_world(exact(hand_eye)), walls).min(dim=1)
            # A tool at 1 m/s is off by 0.1 m after 0.1 s of lag.
            near = off < 1 / 10
            times += [self._times[k]] * int(near.sum())
            points.append(se3.transformed(hand_eye, seen.points[near]).numpy())
            on.append(found.walls[nearest[near].numpy()])
        if not times:
            return lag
        return refine_lag(
            self._track, np.array(times), np.concatenate(points), np.concatenate(on), lag
        )

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
            camera=self._source.camera,
            depth_kind=options.depth_kind,
            modulation_frequency=options.modulation_frequency_hz,
            saturation_amplitude=options.saturation_amplitude,
            tool_from_camera=found.tool_from_camera if known is None else known,
            planes="estimated",
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
    return [
        f"Images are stamped {1000 * abs(lag.seconds):.0f} ± {2000 * lag.standard_error:.0f} ms "
        f"{when} against the poses; this lag was removed. Add --lag-s 0 to keep the stamps as they "
        "are."
    ]


def _contradiction(
    known: np.ndarray | None, found: np.ndarray, far_mm: float = 50.0, far_deg: float = 3.0
) -> list[str]:
    """Return a sentence if the walls contradict a known hand-eye transform; else nothing.

    Args:
        known: tool_from_camera as the source states it, shape (4, 4); None: it does not.
        found: tool_from_camera under which the walls fit best, shape (4, 4).
        far_mm: It is doubted from so many millimetres on: a few times what an uncalibrated
            camera's error moves the estimate.
        far_deg: The same for its rotation, degrees.
    """
    if known is None:
        return []
    shift, turn = se3.apart(torch.as_tensor(known), torch.as_tensor(found))
    if 1000 * shift < far_mm and math.degrees(turn) < far_deg:
        return []
    return [
        f"The walls fit best with the camera {1000 * shift:.0f} mm and {math.degrees(turn):.1f} "
        "degrees away from where its poses place it. Are the poses those of the depth camera?"
    ]
