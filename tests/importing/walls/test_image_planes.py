"""The planes of one image are those of the room it shows."""

import numpy as np
import pytest
import torch
from importing.walls.rendered_room import (
    ROOM,
    Room,
    Views,
    hand_eye_anywhere,
    pinhole,
    poses_in_room,
)

from tofcorr.importing.walls.image_planes import (
    ImagePlane,
    WallOptions,
    plane_masks,
    planes_of_image,
)

OPTIONS = WallOptions()
# What the camera's error of 10 to 20 mm moves and tilts a plane by at most, when walls of half a
# metre are seen.
MOVED, TILTED = 0.06, np.radians(4.0)


def planes_of(room: Room, depth: np.ndarray, seed: int = 0) -> list[ImagePlane]:
    distance = torch.from_numpy(depth)
    rays = torch.from_numpy(room.rays)
    return planes_of_image(distance, distance.isfinite(), rays, OPTIONS, seed=seed)


def shown(room: Room, pose: np.ndarray, plane: ImagePlane) -> int | None:
    """Return which plane of the room a plane found is; None if it is none of them."""
    normal = pose[:3, :3] @ plane.normal.numpy()
    for k, (true, offset) in enumerate(room.planes):
        height = np.array(true) @ pose[:3, 3] + offset
        if normal @ np.array(true) > np.cos(TILTED) and abs(plane.offset - height) < MOVED:
            return k
    return None


def rendered(room: Room, number: int, seed: int) -> tuple[np.ndarray, Views]:
    generator = np.random.default_rng(seed)
    poses = poses_in_room(number, generator)
    return poses, room.views(poses, generator)


@pytest.mark.parametrize("room", [Room(), Room(pinhole(320, 240, 285.0), clutter=0.2)])
def test_every_large_plane_is_found_once_and_pixels_are_given_to_the_right_one(room: Room) -> None:
    poses, views = rendered(room, 12, seed=3)
    for pose, depth, true in zip(poses, views.depth, views.plane, strict=True):
        planes = planes_of(room, depth)
        found = [shown(room, pose, plane) for plane in planes]
        share = np.array([(true == k).mean() for k in range(len(room.planes))])
        # Between the least share and twice that the camera's error and edges may decide.
        assert {int(k) for k in np.flatnonzero(share > 2 * OPTIONS.least_share)} <= set(found)
        walls = [k for k in found if k is not None]
        assert len(walls) == len(set(walls))
        distance, rays = torch.from_numpy(depth), torch.from_numpy(room.rays)
        gradients = torch.stack([-plane.normal / plane.offset for plane in planes])
        tolerance = OPTIONS.tolerance_mm * 1e-3
        masks = plane_masks(distance, distance.isfinite(), rays, gradients, tolerance).numpy()
        for k, mask in zip(found, masks, strict=True):
            if k is not None and share[k] > 2 * OPTIONS.least_share:
                assert (true[mask] == k).mean() > 0.95
                assert mask[true == k].mean() > 0.85
        assert masks.sum(axis=0).max() <= 1


def test_an_error_of_centimetres_does_not_split_a_wall() -> None:
    room = Room(planes=(ROOM[1],), error=2.0)
    _, views = rendered(room, 12, seed=4)
    seen = [k for k in range(12) if (views.plane[k] == 0).mean() > 0.5]
    assert len(seen) > 3
    assert {len(planes_of(room, views.depth[k])) for k in seen} == {1}


def test_the_same_generator_gives_the_same_planes_and_another_nearly_the_same() -> None:
    room = Room(tool_from_camera=hand_eye_anywhere(np.random.default_rng(0)))
    _, views = rendered(room, 3, seed=6)
    for depth in views.depth:
        first, again, other = (planes_of(room, depth, seed) for seed in (0, 0, 1))
        for one, two, three in zip(first, again, other, strict=True):
            torch.testing.assert_close(one.normal, two.normal, rtol=0, atol=0)
            torch.testing.assert_close(one.normal, three.normal, rtol=0, atol=2e-3)


def test_without_noise_the_plane_is_exact() -> None:
    exact = Room(planes=(ROOM[1],), noise=0.0, error=0.0)
    poses = poses_in_room(6, np.random.default_rng(8), towards=(2.0, 0.0, 0.9))
    for pose, depth in zip(poses, exact.views(poses, np.random.default_rng(0)).depth, strict=True):
        (plane,) = planes_of(exact, depth)
        normal = pose[:3, :3].T @ np.array(ROOM[1][0])
        true = -normal / (np.array(ROOM[1][0]) @ pose[:3, 3] + ROOM[1][1])
        np.testing.assert_allclose((-plane.normal / plane.offset).numpy(), true, atol=1e-9)
        points = depth[..., None] * exact.rays
        flat = points[np.isfinite(depth)]
        # Four points stand for all: they have the same mean and second moments.
        four = plane.points.numpy()
        np.testing.assert_allclose(four.mean(axis=0), flat.mean(axis=0), atol=1e-9)
        np.testing.assert_allclose(np.cov(four.T, ddof=0), np.cov(flat.T, ddof=0), atol=1e-9)
