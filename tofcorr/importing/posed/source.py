"""Images from a moving robot as an import: pair, choose, find walls, write a frame a wall."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from tofcorr.data.header import FrameNames
from tofcorr.data.writing import RecordingWriter
from tofcorr.errors import CalibrationDataError
from tofcorr.importing.engine import PreparedImport, camera_mapping, run_import
from tofcorr.importing.posed.chosen import Chosen, choose
from tofcorr.importing.posed.drive import Drive
from tofcorr.importing.posed.explanations import Suspect, explain_misfit
from tofcorr.importing.posed.first_look import FirstLook, look
from tofcorr.importing.posed.images import RadialImages
from tofcorr.importing.posed.known_hand_eye import contradiction
from tofcorr.importing.posed.lag_words import lag_mapping, lag_warnings
from tofcorr.importing.posed.moving_planes import lag_from_moving_planes
from tofcorr.importing.posed.options import PosedOptions
from tofcorr.importing.posed.units import refuse_impossible_depth, refuse_impossible_poses
from tofcorr.importing.posed.wall_frames import WallFrames
from tofcorr.importing.report import ImportReport
from tofcorr.importing.sieve import Progress, Sieve, no_progress
from tofcorr.importing.source import DepthSource
from tofcorr.importing.timing.far_lag import far_lags
from tofcorr.importing.timing.lag import Lag, estimate_lag, known_lag
from tofcorr.importing.walls.finding import PosedImages, walls_of_planes
from tofcorr.importing.walls.found import FoundWalls

_LAG_OF_STOPS = 0.02
"""A refined lag that differs by more than this from the first (seconds) changes which images are
at rest: the margin that stops are given."""


def import_posed(
    drive: Drive, out: Path, options: PosedOptions, progress: Progress = no_progress
) -> ImportReport:
    """Turn depth images and robot poses into a recording of walls.

    Args:
        drive: Images and poses.
        out: The recording to write; it must not exist yet.
        options: How to pair, choose and look for walls.
        progress: Shows how far a step has come.

    Raises:
        CalibrationDataError: Images and poses do not belong together, a unit must be wrong, no
            wall is found, or `out` exists or cannot be written.
    """
    return run_import(RobotImages(drive, options), out, progress)


class RobotImages:
    """Depth images and the poses of the robot; a `tofcorr.importing.engine.ImageSource`."""

    def __init__(self, drive: Drive, options: PosedOptions) -> None:
        self.folder = Path(drive.source.origin)
        self.options = options
        self._drive, self._source = drive, drive.source
        times = drive.source.times
        self._times = None if times is None else times + options.time_offset_s
        self._track = drive.track.inverse() if options.eye_to_hand else drive.track
        self._images = RadialImages(drive.source, options, named=drive.targets is not None)

    def prepare(self, sieve: Sieve) -> PreparedImport:
        """Read all images once or twice, and find out everything but the frames themselves."""
        source, options = self._source, self.options
        seen = look(source, sieve.progress)
        refuse_impossible_depth(seen.median_depth, source.origin)
        lag = self._first_lag(seen)
        chosen = self._choose(seen, lag)
        refuse_impossible_poses(chosen.world_from_tool, self._track.source)
        found, warnings = self._walls(chosen, seen, sieve)
        if lag is not None and options.lag_s == "auto":
            refined = self._refined(lag, chosen, found, sieve)
            if options.moving == "keep" or abs(refined.seconds - lag.seconds) > _LAG_OF_STOPS:
                chosen = self._choose(seen, refined)
                found, warnings = self._walls(chosen, seen, sieve)
            lag = refined
        sieve.refused += [*self._drive.refused, *seen.refused, *chosen.refused]
        sieve.refused += [
            replace(one, view=_named(one.view, source, chosen)) for one in found.left_out
        ]
        tolerance = 1e-3 * options.walls.tolerance_mm
        frames = WallFrames(self._images, self._times, chosen, found, tolerance)
        return PreparedImport(
            views=frames.reported(),
            frame=frames.frame,
            open_writer=lambda path: self._writer(path, found),
            camera=camera_mapping(source.camera, source.origin),
            findings={
                "paired_by": chosen.paired_by,
                "stops": len(np.unique(chosen.stop[chosen.stop >= 0])),
                "lag": None if lag is None else lag_mapping(lag),
                **_findings(found),
            },
            warnings=[
                *self._drive.warnings,
                *lag_warnings(lag, options),
                *warnings,
                *contradiction(self._drive.tool_from_camera, found.tool_from_camera),
                *found.warnings,
            ],
        )

    def _first_lag(self, seen: FirstLook) -> Lag | None:
        """Return the lag as given, or estimated from how images and poses change."""
        if self._times is None or self._track.timestamp is None:
            return None
        if self.options.lag_s != "auto":
            return known_lag(self.options.lag_s)
        if self._lists_stops():
            return None
        readable = np.flatnonzero(seen.readable)
        return estimate_lag(self._track, self._times[readable], seen.change[readable][1:])

    def _choose(self, seen: FirstLook, lag: Lag | None) -> Chosen:
        names, readable = self._source.names, seen.readable
        return choose(names, self._times, readable, self._track, self.options, lag)

    def _refined(self, lag: Lag, chosen: Chosen, found: FoundWalls, sieve: Sieve) -> Lag:
        assert self._times is not None
        return lag_from_moving_planes(
            self._images,
            self._track,
            self._times,
            chosen.moving,
            found,
            lag,
            sieve.progress,
        )

    def _walls(self, chosen: Chosen, seen: FirstLook, sieve: Sieve) -> tuple[FoundWalls, list[str]]:
        """Find walls, and a sentence about a mistake that would explain why they do not fit."""
        targets = self._drive.targets
        posed = PosedImages(
            origin=self._source.origin,
            camera=self._source.camera,
            world_from_tool=chosen.world_from_tool,
            targets=None if targets is None else targets[chosen.images],
        )
        planes = [
            self._images.planes(k) for k in sieve.progress(chosen.images.tolist(), "finding walls")
        ]
        walls = self.options.walls
        if targets is not None:
            return walls_of_planes(posed, planes, np.eye(4), walls), []
        suspect = Suspect(
            images=self._images,
            chosen=chosen,
            options=walls,
            lists=chosen.paired_by != "time" or self._lists_stops(),
            far_lags=lambda: self._far_lags(seen),
            at_lag=lambda late: self._choose(seen, known_lag(late)),
        )
        try:
            found = walls_of_planes(posed, planes, np.eye(4), walls)
        except CalibrationDataError:
            explain_misfit(suspect, None)
            raise
        sentence = explain_misfit(suspect, found)
        return found, [] if sentence is None else [sentence]

    def _lists_stops(self) -> bool:
        return self._track.lists_stops(self.options.pose_tolerance_s)

    def _far_lags(self, seen: FirstLook) -> list[float]:
        """Return lags of seconds that may explain why walls do not fit."""
        if self._times is None or self._track.timestamp is None or self._lists_stops():
            return []
        readable = np.flatnonzero(seen.readable)
        return far_lags(self._track, self._times[readable], seen.change[readable][1:])

    def _writer(self, path: Path, found: FoundWalls) -> RecordingWriter:
        options, known = self.options, self._drive.tool_from_camera
        return RecordingWriter(
            path,
            camera=self._source.camera,
            depth_kind=options.depth_kind,
            modulation_frequency=options.modulation_frequency_hz,
            saturation_amplitude=options.saturation_amplitude,
            tool_from_camera=found.tool_from_camera if known is None else known,
            planes="estimated",
            frame_names=_frame_names(options),
        )


def _frame_names(options: PosedOptions) -> FrameNames:
    """Return the names as the recording format has them.

    Where the robot carries the target, its tool is the recording's world, and its base carries the
    camera.
    """
    names = options.frames
    if not options.eye_to_hand:
        return names
    return names.model_copy(update={"world": names.tool, "tool": names.world, "eye_to_hand": True})


def _findings(found: FoundWalls) -> dict[str, Any]:
    """Return what `import.json` says of the walls; refusals and warnings stand there already."""
    mapping = found.to_mapping()
    return {key: mapping[key] for key in mapping.keys() - {"left_out", "warnings"}}


def _named(view: str, source: DepthSource, chosen: Chosen) -> str:
    """Replace the number in 'image 3, plane 2' by the image's name."""
    head, comma, tail = view.partition(",")
    number = int(head.split()[1])
    return f"{source.names[chosen.images[number]]}{comma}{tail}"
