"""A sensor of one ray before walls: its ray and origin, and what it cannot see."""

from pathlib import Path

import numpy as np
import pytest
from importing.walls.rendered_room import (
    FRONT,
    SLANTED,
    found_in_images,
    hand_eye_anywhere,
    imported,
    poses_in_room,
)
from importing.walls.wall_trials import ONE_PIXEL, read_trial

import tofcorr


def before_two_walls(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return images of one pixel, poses, the walls' names and the hand-eye transform."""
    generator = np.random.default_rng(seed)
    hand_eye = hand_eye_anywhere(generator)
    poses, distances, targets = [], [], []
    for name, (normal, offset), towards in (
        ("front", FRONT, (2.0, 0.0, 0.6)),
        ("slanted", SLANTED, (1.0, -1.2, 0.6)),
    ):
        camera = poses_in_room(32, generator, towards)
        ray = camera[:, :3, 2]
        distance = -(camera[:, :3, 3] @ np.array(normal) + offset) / (ray @ np.array(normal))
        poses.append(camera @ np.linalg.inv(hand_eye))
        distances.append(distance + 0.001 * generator.normal(size=len(distance)))
        targets += [name] * len(distance)
    images = np.concatenate(distances)[:, None, None]
    return images, np.concatenate(poses), np.array(targets), hand_eye


@pytest.mark.parametrize(
    "seed", [*(pytest.param(one, marks=pytest.mark.slow) for one in (0, 40)), 150]
)
def test_ray_and_origin_are_found_from_distances_wherever_the_sensor_points(seed: int) -> None:
    images, poses, targets, hand_eye = before_two_walls(seed)
    found = found_in_images(images, ONE_PIXEL, poses, targets=targets)
    assert found.names == ["front", "slanted"]
    for wall, (normal, offset) in zip(found.walls, (FRONT, SLANTED), strict=True):
        np.testing.assert_allclose(wall[:3], normal, atol=0.005)
        assert wall[3] == pytest.approx(offset, abs=0.02)
    ray, true = found.tool_from_camera[:3, 2], hand_eye[:3, 2]
    assert np.degrees(np.arccos(min(1.0, ray @ true))) < 0.3
    apart = found.tool_from_camera[:3, 3] - hand_eye[:3, 3]
    # A turn of 0.3 degrees and a shift of 8 mm agree at the walls, 1.5 m away.
    assert np.linalg.norm(apart - (apart @ true) * true) < 0.02


def test_a_run_of_one_ray_survives_wrong_readings_and_asks_only_for_what_it_can_show(
    tmp_path: Path,
) -> None:
    """Robust weights left out every reading, and advice and warnings were about the roll."""
    images, poses, targets, hand_eye = before_two_walls(150)
    images[[3, 40]] += 0.3
    recording, _ = imported(tmp_path / "ray", ONE_PIXEL, poses, images, None, targets)
    result = tofcorr.train(recording, "zones")
    found = result.fit.solution.parameters.tool_from_camera.numpy()
    # Without them, or without robust weights: 0.3 and 7 degrees.
    assert np.degrees(np.arccos(found[:3, 2] @ hand_eye[:3, 2])) < 0.5
    advice = result.report["advice"]
    assert "w_z" not in advice["direction"]
    assert advice["poses"][-1]["worst_sigma_mm_or_mrad"] < advice["worst_sigma_mm_or_mrad"] < 50
    (hidden,) = (one for one in result.report["warnings"] if "w_z" in one)
    assert hidden.startswith("From no pose does one ray show w_z")
    assert "principal point" not in repr(result)
    assert "100.0 mrad only" not in repr(result)


def test_an_image_without_a_reading_is_left_out(tmp_path: Path, real_data: Path) -> None:
    poses, distance = read_trial(real_data, "R1", "P1")
    distance[5] = np.nan
    targets = np.full(len(poses), "R1")
    found = found_in_images(distance[:, None, None], ONE_PIXEL, poses, targets=targets)
    assert 5 not in found.image
    assert list(found.left_out) == ["image 5"]
