"""Poses of the tool in the world, by time or by name."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from tofcorr.errors import CalibrationDataError
from tofcorr.geometry import se3

LEAST_SECONDS = 1e8
"""Seconds since 1970 from which on a number is a time: in 1973. A thousand times as much counts
milliseconds, and so on; in seconds that would be the year 5138."""


def in_seconds(stamps: np.ndarray) -> np.ndarray:
    """Return time stamps in seconds, shape (N,).

    Args:
        stamps: In seconds; or in milliseconds, microseconds or nanoseconds since 1970, which are
            told by their size. All are in one unit.

    Example:
        >>> in_seconds(np.array([1_700_000_000_500_000_000])).tolist()
        [1700000000.5]
    """
    least = float(stamps.min()) if len(stamps) else 0.0
    finer = sum(least >= LEAST_SECONDS * 1000**steps for steps in (1, 2, 3))
    return stamps * 1000.0**-finer


@dataclass(frozen=True, kw_only=True, eq=False)
class PoseTrack:
    """Poses that one file or one topic holds.

    Attributes:
        world_from_tool: Shape (P, 4, 4), metres, rigid.
        timestamp: Shape (P,), seconds, strictly increasing; None where the file gives no times.
        names: What each pose is called in the file, such as an image's name; None without names.
        source: Where they come from, for messages.
        of_row: The pose of each row of the file, shape (R,): rows that repeat time stamp and pose
            of the one before have one pose.
    """

    world_from_tool: np.ndarray
    timestamp: np.ndarray | None
    names: tuple[str, ...] | None
    source: str
    of_row: np.ndarray

    def __len__(self) -> int:
        """Return the number of poses."""
        return len(self.world_from_tool)

    @classmethod
    def checked(
        cls,
        world_from_tool: np.ndarray,
        source: str,
        timestamp: np.ndarray | None = None,
        names: Sequence[str] | None = None,
    ) -> Self:
        """Build a track after checking that every pose is rigid and that times increase.

        Rotations that are orthonormal to 0.001 are made exact: files round them. Equal poses of
        equal time stamps are one pose (`of_row`). Stamps may count finer units than seconds since
        1970.

        Raises:
            CalibrationDataError: There is no pose, a pose is not rigid, times decrease, or two
                different poses carry one time stamp. The message names the pose.
        """
        poses = np.asarray(world_from_tool, dtype=np.float64)
        if not len(poses):
            raise CalibrationDataError(f"{source}: expected poses, found none.")
        for place, pose in enumerate(poses):
            try:
                se3.refuse_unless_rigid(pose)
            except ValueError as error:
                raise CalibrationDataError(f"{source}: pose {place}: {error}.") from None
        poses = np.stack([se3.nearest_rigid(pose) for pose in poses])
        kept, time = np.arange(len(poses)), None
        if timestamp is not None:
            time = in_seconds(np.asarray(timestamp, dtype=np.float64))
            kept = _without_repeats(time, poses, source)
            time = time[kept]
        own = None if names is None else tuple(names[int(k)] for k in kept)
        at = np.searchsorted(kept, np.arange(len(poses)), side="right") - 1
        return cls(world_from_tool=poses[kept], timestamp=time, names=own, source=source, of_row=at)

    @property
    def repeats(self) -> list[str]:
        """Say how many rows repeat another one, without a full stop; nothing if none does."""
        count = len(self.of_row) - len(self)
        said = f"{self.source}: {count} poses repeat time stamp and pose of the one before"
        return [said] * (count > 0)

    def at(self, times: np.ndarray) -> np.ndarray:
        """Return the poses at some times, shape (N, 4, 4); NaN outside the track, if it has times.

        Between two poses the translation moves on a straight line at constant speed, and the
        rotation about a fixed axis at constant angular speed.

        Args:
            times: Shape (N,), seconds on the clock of the track.
        """
        poses = np.tile(self.world_from_tool[0], (len(times), 1, 1))
        if self.timestamp is None:
            return poses
        clipped = np.clip(times, self.timestamp[0], self.timestamp[-1])
        if len(self) > 1:
            poses[:, :3, :3] = self._rotation(clipped).as_matrix()
            for axis, along in enumerate(self.world_from_tool[:, :3, 3].T):
                poses[:, axis, 3] = np.interp(clipped, self.timestamp, along)
        poses[clipped != times] = np.nan
        return poses

    @cached_property
    def _rotation(self) -> Slerp:
        assert self.timestamp is not None
        return Slerp(self.timestamp, Rotation.from_matrix(self.world_from_tool[:, :3, :3]))

    def lists_stops(self, tolerance: float) -> bool:
        """Whether poses are typically so far apart in time (over twice `tolerance`, seconds).

        Then the robot's way between them is unknown: they are taken as those of stops, and an image
        has the nearest one.
        """
        if self.timestamp is None or len(self) == 1:
            return True
        return float(np.median(np.diff(self.timestamp))) > 2 * tolerance


def nearest(stamps: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Return which of increasing `stamps` is nearest to each of `times`, the earlier of two."""
    after = np.clip(np.searchsorted(stamps, times), 0, len(stamps) - 1)
    before = np.maximum(after - 1, 0)
    later = np.abs(times - stamps[after]) < np.abs(times - stamps[before])
    return np.where(later, after, before)


def _without_repeats(time: np.ndarray, poses: np.ndarray, source: str) -> np.ndarray:
    """Return which poses to keep; refuse times that decrease or contradict one another."""
    before = np.concatenate([[-np.inf], time[:-1]])
    for place in np.flatnonzero(~(time >= before) | ~np.isfinite(time)):
        stamps = f"{before[place]:.6f} s, then {time[place]:.6f} s"
        raise CalibrationDataError(f"{source}: pose {place}: expected increasing times, {stamps}.")
    same = np.flatnonzero(time == before)
    for place in same:
        if not np.allclose(poses[place], poses[place - 1]):
            said = f"pose {place} repeats the time {time[place]:.6f} s"
            raise CalibrationDataError(f"{source}: {said}; are stamps rounded?")
    return np.setdiff1d(np.arange(len(time)), same)
