"""Images from a moving robot as an import: pair, choose, find walls, write a frame a wall."""

import math
from collections.abc import Iterator
from functools import partial
from itertools import groupby
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
from tofcorr.importing.walls.gathering import distances, seen_planes
from tofcorr.importing.walls.image_planes import wall_masks

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
        self._lists_stops = self._track.lists_stops(options.pose_tolerance_s)

    def prepare(self, sieve: Sieve) -> PreparedImport:
        """Read all images once or twice, and find out everything but the frames themselves."""
        source, options = self._source, self._options
        self._readable, median, self._change, refused = look(source, sieve.progress)
        refuse_impossible_depth(median, source.origin)
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
        sieve.refused += [*source.refused, *refused, *chosen.refused]
        for one in found.left_out:
            # 'image 3, plane 2': the number among the images chosen becomes the image's name.
            head, comma, tail = one.view.partition(",")
            name = source.names[chosen.images[int(head.split()[1])]]
            sieve.refused.append(one._replace(view=f"{name}{comma}{tail}"))
        mapping = found.to_mapping()
        return PreparedImport(
            views=self._reported(chosen, found),
            frames=self._frames(chosen, found),
            writer=self._writer(found),
            camera=camera_mapping(source.camera, source.origin),
            findings={
                "paired_by": chosen.paired_by,
                "stops": len(np.unique(chosen.stop[chosen.stop >= 0])),
                "lag": None if lag is None else _lag_mapping(lag),
                # Refusals and warnings stand there already.
                **{key: mapping[key] for key in mapping if key not in ("left_out", "warnings")},
            },
            warnings=[
                *source.warnings,
                *([] if lag is None or options.lag_s != "auto" else _lag_warnings(lag)),
                *warnings,
                *_contradiction(source.tool_from_camera, found.tool_from_camera),
                *found.warnings,
            ],
        )

    def _first_lag(self) -> Lag | None:
        """Return the lag as given, or estimated from how images and poses change."""
        if self._times is None or self._track.timestamp is None:
            return None
        if self._options.lag_s != "auto":
            return Lag(seconds=self._options.lag_s)
        if self._lists_stops:
            return None
        return estimate_lag(self._track, self._times[self._readable], self._changes())

    def _changes(self) -> np.ndarray:
        """Return how much each readable image differs from the one before, metres."""
        return self._change[self._readable][1:]

    def _choose(self, lag: Lag | None) -> Chosen:
        names = self._source.names
        return choose(names, self._times, self._readable, self._track, self._options, lag)

    def _walls(self, chosen: Chosen, sieve: Sieve) -> tuple[FoundWalls, list[str]]:
        """Find walls, and a sentence about a mistake that would explain why they do not fit."""
        source, options = self._source, self._options.walls
        numbers = sieve.progress(chosen.images.tolist(), "finding walls")
        planes = [self._images.planes(k) for k in numbers]
        targets = None if source.targets is None else source.targets[chosen.images]

        def far() -> list[float]:
            """Return lags of seconds that may explain why walls do not fit."""
            if self._times is None or self._track.timestamp is None or self._lists_stops:
                return []
            return far_lags(self._track, self._times[self._readable], self._changes())

        explain = partial(
            explain_misfit,
            self._images,
            chosen,
            options=options,
            lists=chosen.paired_by != "time" or self._lists_stops,
            far_lags=far,
            at_lag=lambda late: self._choose(Lag(seconds=late)),
        )
        try:
            pixels, poses = source.camera.width * source.camera.height, chosen.world_from_tool
            found = walls_of_planes(
                planes, pixels, poses, np.eye(4), options, source.origin, targets
            )
        except CalibrationDataError:
            if targets is None:
                explain(given=None)
            raise
        sentence = explain(given=found) if targets is None else None
        return found, [] if sentence is None else [sentence]

    def _refined(
        self, lag: Lag, moving: np.ndarray, found: FoundWalls, sieve: Sieve, most: int = 200
    ) -> Lag:
        """Refine the lag on images that were taken while the tool moved, `most` of them.

        At 0.1 m/s and 10 mm a plane, the mean of 200 tells 1 to 2 ms, a fifth of what matters.
        """
        assert self._times is not None
        hand_eye, walls = torch.from_numpy(found.tool_from_camera), found.planes()
        times, points, on = [], [], []
        step = max(1, -(-len(moving) // most))
        for k in sieve.progress(moving[::step].tolist(), "refining the lag"):
            pose = torch.from_numpy(self._track.at(self._times[k : k + 1] - lag.seconds))
            if not bool(pose.isfinite().all()) or not self._images.planes(k):
                continue
            seen = seen_planes([self._images.planes(k)], pose, 1)
            off, nearest = distances(seen, hand_eye, walls).min(dim=1)
            # A tool at 1 m/s is off by 0.1 m after 0.1 s of lag.
            for plane in (off < 1 / 10).nonzero()[:, 0].tolist():
                wall = found.walls[int(nearest[plane])]
                times.append(self._times[k])
                points.append((seen.points[plane] @ hand_eye[:3, :3].T + hand_eye[:3, 3]).numpy())
                on.append([*wall.normal_world, wall.offset])
        if not times:
            return lag
        return refine_lag(self._track, np.array(times), np.stack(points), np.array(on), lag)

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
        reported = []
        for view in found.views:
            number = int(chosen.images[view.image])
            time = None if self._times is None else float(self._times[number])
            reported.append({
                "view": self._source.names[number],
                "wall": found.walls[view.wall].name,
                "stop": int(chosen.stop[view.image]),
                "timestamp_s": time,
            })  # fmt: skip
        return reported

    def _frames(self, chosen: Chosen, found: FoundWalls) -> Iterator[Frame]:
        """Yield one frame for each image and wall."""
        for place, group in groupby(found.views, key=lambda view: view.image):
            number, views = int(chosen.images[place]), list(group)
            image, stop = self._images.read(number), int(chosen.stop[place])
            distance, valid = self._images.along_rays(image)
            tolerance = 1e-3 * self._options.walls.tolerance_mm
            gradients = [view.gradient for view in views]
            masks = wall_masks(distance, valid, self._images.rays, gradients, tolerance)
            timestamp = float(place)
            if self._times is not None:
                timestamp = float(self._times[number] - self._times[chosen.images[0]])
            for view, mask in zip(views, masks, strict=True):
                wall = found.walls[view.wall]
                row = FrameRow(
                    timestamp=timestamp,
                    world_from_tool=chosen.world_from_tool[place],
                    normal_world=wall.normal_world,
                    offset=wall.offset,
                    target=wall.name,
                    pose_id=f"stop {stop}" if stop >= 0 else f"image {number}",
                )
                yield row, image.depth, image.amplitude, mask


def _lag_mapping(lag: Lag) -> dict[str, float | None]:
    """Return what `import.json` says of the lag."""
    return {
        "seconds": round(lag.seconds, 5),
        "standard_error": round(lag.standard_error, 5),
        "correlation": None if math.isnan(lag.correlation) else round(lag.correlation, 3),
    }


def _lag_warnings(lag: Lag) -> list[str]:
    """Return a sentence about an estimated lag that is not zero.

    It is named from three standard errors on, and from 5 ms: at 0.2 m/s that is 1 mm.
    """
    if abs(lag.seconds) < max(3 * lag.standard_error, _LAG_OF_STOPS / 4):
        return []
    when = "late" if lag.seconds > 0 else "early"
    return [
        f"Images are stamped {1e3 * abs(lag.seconds):.0f} ± {2e3 * lag.standard_error:.0f} ms "
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
    if 1e3 * shift < far_mm and math.degrees(turn) < far_deg:
        return []
    return [
        f"The walls fit best with the camera {1e3 * shift:.0f} mm and {math.degrees(turn):.1f} "
        "degrees away from where its poses place it. Are the poses those of the depth camera?"
    ]
