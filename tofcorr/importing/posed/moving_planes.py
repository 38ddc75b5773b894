"""Planes seen while the tool moved, and the walls they show: what refines the lag."""

from collections.abc import Callable, Iterable

import numpy as np
import torch
from torch import Tensor

from tofcorr.importing.posed.images import RadialImages
from tofcorr.importing.posed.lag_refinement import refine_lag
from tofcorr.importing.poses.track import PoseTrack
from tofcorr.importing.timing.lag import Lag
from tofcorr.importing.walls.found import FoundWalls

_MOST_MOVING = 200
"""Images taken in motion that refine the lag. At 0.1 m/s and 10 mm a plane, their mean tells 1 to
2 ms, a fifth of the 10 ms that matter."""

_NEAR = 0.1
"""Metres between a plane and its wall: a tool at 1 m/s is off by this much after 0.1 s of lag."""

_FACING = float(np.cos(np.radians(12.0)))
"""Least cosine between a plane's normal and its wall's: planes of two walls differ by more."""


def lag_from_moving_planes(
    images: RadialImages,
    track: PoseTrack,
    times: np.ndarray,
    moving: np.ndarray,
    found: FoundWalls,
    first: Lag,
    progress: Callable[[Iterable[int], str], Iterable[int]],
) -> Lag:
    """Refine the lag on images that were taken while the tool moved.

    Args:
        images: All images.
        track: The poses, with time stamps.
        times: Of all images, shape (I,), seconds.
        moving: Numbers of the images taken in motion, shape (K,).
        found: The walls, found in images of stops.
        first: The lag to start from.
        progress: Shows how far this has come.
    """
    step = max(1, -(-len(moving) // _MOST_MOVING))
    seen: list[tuple[float, Tensor, int]] = []
    for k in progress(moving[::step].tolist(), "refining the lag"):
        pose = track.at(times[k : k + 1] - first.seconds)[0]
        if not np.isfinite(pose).all():
            continue
        for plane in images.planes(k):
            wall = _nearest_wall(plane.points, plane.normal, pose, found)
            if wall is not None:
                seen.append((float(times[k]), plane.points, wall))
    if not seen:
        return first
    walls = [found.walls[wall] for _, _, wall in seen]
    return refine_lag(
        track,
        np.array([time for time, _, _ in seen]),
        torch.stack([points for _, points, _ in seen]),
        torch.from_numpy(np.stack([wall.normal_world for wall in walls])),
        torch.tensor([wall.offset for wall in walls], dtype=torch.float64),
        found.tool_from_camera,
        first,
    )


def _nearest_wall(
    points: Tensor, normal: Tensor, world_from_tool: np.ndarray, found: FoundWalls
) -> int | None:
    """Return the wall that a plane lies on and faces; None: on none."""
    pose = torch.from_numpy(world_from_tool @ found.tool_from_camera)
    there = points @ pose[:3, :3].T + pose[:3, 3]
    turned = pose[:3, :3] @ normal
    best, least = None, _NEAR
    for number, wall in enumerate(found.walls):
        towards = torch.from_numpy(wall.normal_world)
        off = float((there @ towards + wall.offset).square().mean().sqrt())
        if off < least and float(towards @ turned) > _FACING:
            best, least = number, off
    return best
