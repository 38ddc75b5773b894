"""Walls of a room are found and matched, wherever the camera sits on the tool."""

from dataclasses import replace

import numpy as np
import pytest
from cameras import apart
from importing.walls.rendered_room import (
    CUPBOARD,
    FLOOR,
    FRONT,
    SLANTED,
    Room,
    Views,
    found_in,
    hand_eye_anywhere,
    looking_straight,
    pinhole,
    poses_in_room,
)

from tofcorr.errors import CalibrationDataError
from tofcorr.importing.walls.finding import FoundWalls

# How near a start is: the camera's error of 10 to 20 mm is not calibrated yet.
NEAR_MM, NEAR_DEG = 20.0, 0.6


def room_and_views(
    seed: int, number: int = 20, towards: tuple[float, float, float] | None = None, **parts: object
) -> tuple[Room, Views]:
    generator = np.random.default_rng(seed)
    room = Room(tool_from_camera=hand_eye_anywhere(generator), **parts)  # type: ignore[arg-type]
    return room, room.views(poses_in_room(number, generator, towards), generator)


def planes_shown(room: Room, found: FoundWalls) -> list[int]:
    """Return which plane of the room each wall is; every wall must be one of them."""
    shown = []
    for wall in found.walls:
        off = [
            np.degrees(np.arccos(min(1.0, wall[:3] @ np.array(normal)))) / NEAR_DEG
            + abs(wall[3] - offset) * 1e3 / NEAR_MM
            for normal, offset in room.planes
        ]
        assert min(off) < 2, wall
        shown.append(int(np.argmin(off)))
    return shown


@pytest.mark.parametrize(
    ("seed", "clutter"), [(1, 0.2), pytest.param(0, 0.0, marks=pytest.mark.slow)]
)
def test_three_walls_and_a_floor_are_found_in_their_views(seed: int, clutter: float) -> None:
    room, views = room_and_views(seed, number=40, clutter=clutter)
    found = found_in(room, views)
    shown = planes_shown(room, found)
    assert sorted(shown) == [0, 1, 2, 3]
    assert (apart(found.tool_from_camera, room.tool_from_camera) < (NEAR_MM, NEAR_DEG)).all()
    for image, wall in zip(found.image, found.wall, strict=True):
        assert (views.plane[image] == shown[wall]).mean() > 0.03


def test_walls_are_named_by_their_pixels_and_the_lowest_horizontal_one_is_the_floor() -> None:
    room, views = room_and_views(3)
    found = found_in(room, views)
    names = found.names
    assert sorted(names) == ["floor", "wall 1", "wall 2", "wall 3"]
    shown = planes_shown(room, found)
    assert shown[names.index("floor")] == 0
    on_wall = [views.plane[found.image[found.wall == k]] == one for k, one in enumerate(shown)]
    pixels = [int(own.sum()) for name, own in zip(names, on_wall, strict=True) if name != "floor"]
    assert pixels == sorted(pixels, reverse=True)


def test_parallel_walls_are_kept_apart_by_their_places() -> None:
    room, views = room_and_views(4, number=24, planes=(FLOOR, FRONT, CUPBOARD))
    found = found_in(room, views)
    assert sorted(planes_shown(room, found)) == [0, 1, 2]


@pytest.mark.parametrize("planes", [(FRONT,), pytest.param((FLOOR, FRONT), marks=pytest.mark.slow)])
def test_one_wall_is_enough_if_it_is_seen_tilted_about_two_axes(
    planes: tuple[tuple[tuple[float, float, float], float], ...],
) -> None:
    room, views = room_and_views(5, planes=planes, towards=(2.0, 0.0, 0.6))
    found = found_in(room, views)
    assert sorted(planes_shown(room, found)) == list(range(len(planes)))
    assert apart(found.tool_from_camera, room.tool_from_camera)[1] < NEAR_DEG


@pytest.mark.slow
def test_the_answer_does_not_depend_on_the_order_of_the_images() -> None:
    room, views = room_and_views(7, clutter=0.2)
    order = np.random.default_rng(0).permutation(len(views.depth))
    shuffled = Views(*(part[order] for part in vars(views).values()))
    first, second = found_in(room, views), found_in(room, shuffled)
    np.testing.assert_array_equal(first.tool_from_camera, second.tool_from_camera)
    for name in ("names", "walls"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))
    places = set(zip(order[second.image].tolist(), second.wall.tolist(), strict=True))
    assert places == set(zip(first.image.tolist(), first.wall.tolist(), strict=True))


def test_images_that_show_nothing_flat_are_left_out_with_the_reason() -> None:
    room, views = room_and_views(8)
    depth = views.depth.copy()
    depth[3] = np.random.default_rng(0).uniform(0.5, 3.0, depth[3].shape)
    depth[11] = np.nan
    found = found_in(room, replace(views, depth=depth))
    assert {3, 11}.isdisjoint(found.image)
    for image in ("image 3", "image 11"):
        assert "nothing flat covers 5 %" in found.left_out[image]
    assert len(found.image) > 25


def test_a_plane_that_belongs_to_no_wall_is_left_out_with_its_distance() -> None:
    room, views = room_and_views(9, number=30)
    # One image with a pose that is not its own: the next image's, 100 mm and more away.
    poses = views.world_from_tool.copy()
    poses[4, :3, 3] += [0.3, 0.25, 0.3]
    found = found_in(room, replace(views, world_from_tool=poses))
    assert sorted(planes_shown(room, found)) == [0, 1, 2, 3]
    assert 4 not in found.image
    reasons = [why for view, why in found.left_out.items() if view.startswith("image 4,")]
    assert reasons
    assert all("mm from the nearest wall" in reason for reason in reasons)


@pytest.mark.parametrize("roll", [0.0, pytest.param(1.0, marks=pytest.mark.slow)])
def test_one_wall_seen_head_on_keeps_the_guess_of_what_is_not_determined(roll: float) -> None:
    generator = np.random.default_rng(10)
    room = Room(planes=(FRONT,), tool_from_camera=hand_eye_anywhere(generator))
    views = room.views(looking_straight(25, roll, generator), generator)
    found = found_in(room, views)
    (wall,) = found.walls
    # What is determined is right: the robot moves along the wall's normal.
    assert np.degrees(np.arccos(-wall[0])) < NEAR_DEG
    # Nothing is invented: along the wall the translation is that of the guess.
    assert np.linalg.norm(found.tool_from_camera[:3, 3]) < 0.02


def test_few_zones_before_named_walls_need_no_search_in_the_image() -> None:
    generator = np.random.default_rng(11)
    room = Room(pinhole(8, 8, 9.6), (FRONT, SLANTED), hand_eye_anywhere(generator))
    parts = []
    for plane, towards in ((FRONT, (2.0, 0.0, 0.5)), (SLANTED, (1.0, -1.0, 0.5))):
        poses = poses_in_room(20, generator, towards)
        parts.append(replace(room, planes=(plane,)).views(poses, generator))
    views = Views(*map(np.concatenate, zip(*(vars(part).values() for part in parts), strict=True)))
    found = found_in(room, views, targets=np.repeat(["left", "right"], 20))
    assert found.names == ["left", "right"]
    assert planes_shown(room, found) == [0, 1]
    assert apart(found.tool_from_camera, room.tool_from_camera)[1] < NEAR_DEG
    assert found.gradient is None


def test_poses_of_other_images_and_images_without_anything_flat_are_refused_in_words() -> None:
    room, views = room_and_views(12, number=12)
    generator = np.random.default_rng(0)
    poses = np.stack([hand_eye_anywhere(generator) for _ in views.depth])
    poses[:, :3, 3] = generator.uniform(-2, 2, (len(poses), 3))
    with pytest.raises(CalibrationDataError, match="Are poses of these images"):
        found_in(room, replace(views, world_from_tool=poses))
    depth = generator.uniform(0.5, 3.0, views.depth.shape)
    with pytest.raises(CalibrationDataError, match="0 of 12 images show anything flat"):
        found_in(room, replace(views, depth=depth))
