"""Which images are used, with their poses and stops, and why the others are not."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tofcorr.errors import CalibrationDataError
from tofcorr.importing.posed.options import PosedOptions
from tofcorr.importing.poses.track import PoseTrack
from tofcorr.importing.report import Refusal
from tofcorr.importing.timing.lag import Lag
from tofcorr.importing.timing.pairing import pair
from tofcorr.importing.timing.stops import find_stops

_MARGIN = 0.02
"""Seconds before and after an image in which the tool must stand still besides the uncertainty of
the lag: an exposure and the jitter of a time stamp."""


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
    refused: list[Refusal]
    paired_by: str


def choose(
    names: Sequence[str],
    times: np.ndarray | None,
    usable: np.ndarray,
    track: PoseTrack,
    options: PosedOptions,
    lag: Lag | None,
) -> Chosen:
    """Pair images with poses, and keep those of stops.

    Args:
        names: What each image is called.
        times: On the images' clock, shape (I,), seconds; None without times.
        usable: Which images can be read, shape (I,), bool.
        track: The poses.
        options: How to choose.
        lag: Of the images' clock; None: none is known.

    Raises:
        CalibrationDataError: No image is left.
    """
    late = 0.0 if lag is None else lag.seconds
    paired = pair(names, times, track, tolerance=options.pose_tolerance_s, lag=late)
    kept = usable[paired.images]
    images, poses = paired.images[kept], paired.world_from_tool[kept]
    if times is None or track.timestamp is None:
        return Chosen(
            images=images,
            world_from_tool=poses,
            stop=np.arange(len(images)),
            moving=np.zeros(0, dtype=np.int64),
            refused=paired.refused,
            paired_by=paired.by,
        )
    if track.lists_stops(options.pose_tolerance_s):
        stop = track.nearest(times[images] - late)
    else:
        margin = _MARGIN + (0.0 if lag is None else 2 * lag.standard_error)
        stop = find_stops(track, times[images] - late, margin).number
    refused = list(paired.refused)
    take = _few_of_each(stop, options.images_per_stop)
    moving = images[stop < 0]
    if options.moving == "keep":
        take |= stop < 0
    else:
        refused += [
            Refusal(view=names[int(k)], reason="the tool was moving") for k in moving.tolist()
        ]
    refused += [
        Refusal(view=names[int(k)], reason=f"its stop has {options.images_per_stop} images already")
        for k in images[(stop >= 0) & ~take]
    ]
    if not take.any():
        raise CalibrationDataError(
            f"{track.source}: the tool moves in all of {len(images)} images that have a pose. Stop "
            "the robot for each image, or add --keep-moving (each millisecond of lag then counts)."
        )
    return Chosen(
        images=images[take],
        world_from_tool=poses[take],
        stop=stop[take],
        moving=moving,
        refused=refused,
        paired_by=paired.by,
    )


def _few_of_each(stop: np.ndarray, most: int) -> np.ndarray:
    """Return which images to take: at most so many of a stop, evenly spread, the middle first."""
    take = np.zeros(len(stop), dtype=bool)
    for number in np.unique(stop[stop >= 0]):
        own = np.flatnonzero(stop == number)
        count = min(most, len(own))
        take[own[((np.arange(count) + 0.5) * len(own) / count).astype(int)]] = True
    return take
