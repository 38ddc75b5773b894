"""A pose for every image: by time stamp, by name, or by order."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import PurePath

import numpy as np

from tofcorr.errors import CalibrationDataError
from tofcorr.importing.poses.track import PoseTrack
from tofcorr.importing.report import Refusal


@dataclass(frozen=True, kw_only=True, eq=False)
class Pairing:
    """The images that have a pose.

    Attributes:
        images: Their numbers in the source, shape (N,), increasing.
        world_from_tool: Shape (N, 4, 4), metres.
        refused: The images without a pose, and why.
        by: `time`, `name` or `order`.
    """

    images: np.ndarray
    world_from_tool: np.ndarray
    refused: list[Refusal]
    by: str


def pair(
    names: Sequence[str],
    times: np.ndarray | None,
    track: PoseTrack,
    *,
    tolerance: float,
    lag: float = 0.0,
) -> Pairing:
    """Find the pose of every image.

    Where images and poses both carry times, poses are interpolated at the images' times; of poses
    that are listed for stops only, the nearest is taken. Else they are matched by name, and without
    names by order: then there must be as many of both.

    Args:
        names: What each image is called.
        times: Shape (I,), seconds on the images' clock; None without times.
        track: The poses.
        tolerance: Largest time between an image and the nearest pose, seconds.
        lag: How much later an image is stamped than the pose it was taken at, seconds: the pose at
            `time - lag` is taken.

    Raises:
        CalibrationDataError: No image has a pose, or the lists do not belong together.
    """
    if times is not None and track.timestamp is not None:
        return _by_time(names, times - lag, track, tolerance)
    if track.names is not None:
        return _by_name(names, track)
    if len(names) != len(track):
        raise CalibrationDataError(
            f"{track.source}: {len(track)} poses and {len(names)} images, without time stamps or "
            "names that tell which belong together. Expected as many of both; a dropped image "
            "shifts every later pair. Add time stamps, or names."
        )
    return Pairing(
        images=np.arange(len(names)), world_from_tool=track.world_from_tool, refused=[], by="order"
    )


def _by_time(
    names: Sequence[str], times: np.ndarray, track: PoseTrack, tolerance: float
) -> Pairing:
    assert track.timestamp is not None
    _refuse_foreign_clocks(times, track)
    if track.lists_stops(tolerance):
        poses = track.world_from_tool[track.nearest(times)]
    else:
        poses = track.at(times)
    inside = np.asarray(np.isfinite(poses).all(axis=(1, 2)))
    gap = track.nearest_gap(times)
    used = inside & (gap <= tolerance)
    refused = [
        Refusal(view=names[k], reason=_why(bool(inside[k]), float(gap[k]), tolerance))
        for k in np.flatnonzero(~used).tolist()
    ]
    if not used.any():
        raise CalibrationDataError(
            f"{track.source}: none of {len(names)} images has a pose; the first: "
            f"{refused[0].reason}."
        )
    return Pairing(
        images=np.flatnonzero(used), world_from_tool=poses[used], refused=refused, by="time"
    )


def _why(inside: bool, gap: float, tolerance: float) -> str:
    if not inside:
        return f"taken {gap:.3f} s before the first pose or after the last"
    return f"the nearest pose is {gap:.3f} s away, the tolerance is {tolerance:g} s"


def _refuse_foreign_clocks(times: np.ndarray, track: PoseTrack) -> None:
    """Refuse lists of times that share no second."""
    assert track.timestamp is not None
    first, last = float(times.min()), float(times.max())
    start, end = float(track.timestamp[0]), float(track.timestamp[-1])
    if last >= start and first <= end:
        return
    raise CalibrationDataError(
        f"{track.source}: poses are stamped {start:.3f} to {end:.3f} s, images {first:.3f} to "
        f"{last:.3f} s: they share no time. Are they on two clocks? State the difference with "
        f"--time-offset-s (the starts differ by {first - start:.3f} s)."
    )


def _by_name(names: Sequence[str], track: PoseTrack) -> Pairing:
    assert track.names is not None
    place = {PurePath(name).stem: k for k, name in enumerate(track.names)}
    if len(place) < len(track.names):
        twice = next(n for n in place if [PurePath(x).stem for x in track.names].count(n) > 1)
        raise CalibrationDataError(f"{track.source}: two poses are called '{twice}'.")
    found = [place.get(PurePath(name).stem) for name in names]
    images = np.array([k for k, pose in enumerate(found) if pose is not None], dtype=np.int64)
    if not len(images):
        raise CalibrationDataError(
            f"{track.source}: no pose is called as an image is: poses '{track.names[0]}', ..., "
            f"images '{names[0]}', ...."
        )
    chosen = np.array([pose for pose in found if pose is not None])
    refused = [
        Refusal(view=names[k], reason=f"no pose of that name in {track.source}")
        for k, pose in enumerate(found)
        if pose is None
    ]
    return Pairing(
        images=images, world_from_tool=track.world_from_tool[chosen], refused=refused, by="name"
    )
