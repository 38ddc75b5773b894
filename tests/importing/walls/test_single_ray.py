"""A sensor of one ray before walls: its ray and origin, and what it cannot see."""

from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from importing.walls.rendered_room import (
    FRONT,
    SLANTED,
    found_in_images,
    hand_eye_anywhere,
    imported,
    poses_in_room,
)
from importing.walls.wall_trials import MOUNTS, ONE_PIXEL, WALLS, read_trial

from tofcorr.correction.model import CalibrationModel
from tofcorr.data.recording import Recording
from tofcorr.fit.fitting import fit
from tofcorr.fit.problem import Fit
from tofcorr.fit.walls import walls_alone
from tofcorr.pixels.dataset import Dataset, covered_domain
from tofcorr.training.calibration import TrainingOptions

TrialsOf = Callable[[str, tuple[str, ...]], Recording]
"""Gives the recording of a mount before some walls."""

REPEATABLE = 2.0
"""Standard errors within which a mount's origin repeats from wall to wall."""


@pytest.mark.parametrize(
    "seed", [*(pytest.param(one, marks=pytest.mark.slow) for one in (0, 40)), 150]
)
def test_ray_and_origin_are_found_from_distances_wherever_the_sensor_points(seed: int) -> None:
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
    found = found_in_images(images, ONE_PIXEL, np.concatenate(poses), targets=np.array(targets))
    assert found.names == ["front", "slanted"]
    for wall, (normal, offset) in zip(found.walls, (FRONT, SLANTED), strict=True):
        np.testing.assert_allclose(wall[:3], normal, atol=0.005)
        assert wall[3] == pytest.approx(offset, abs=0.02)
    ray, true = found.tool_from_camera[:3, 2], hand_eye[:3, 2]
    assert np.degrees(np.arccos(min(1.0, ray @ true))) < 0.3
    apart = found.tool_from_camera[:3, 3] - hand_eye[:3, 3]
    # A turn of 0.3 degrees and a shift of 8 mm agree at the walls, 1.5 m away.
    assert np.linalg.norm(apart - (apart @ true) * true) < 0.02
    # The turn about the ray cannot be seen, and is said to be open.
    assert "w_z of the hand-eye" in found.undetermined


def test_an_image_without_a_reading_is_left_out(tmp_path: Path, real_data: Path) -> None:
    poses, distance = read_trial(real_data, "R1", "P1")
    distance[5] = np.nan
    targets = np.full(len(poses), "R1")
    found = found_in_images(distance[:, None, None], ONE_PIXEL, poses, targets=targets)
    assert 5 not in found.image
    assert list(found.left_out) == ["image 5"]


def fitted(recording: Recording, degree: int, frames: np.ndarray | None = None) -> Fit:
    terms = [{"kind": "distance_polynomial", "degree": degree}]
    options = TrainingOptions.from_mapping({"name": "D", "model": {"terms": terms}}, "test")
    dataset = Dataset((recording,))
    frames = np.arange(dataset.num_frames) if frames is None else frames
    return fit(dataset, frames, options, covered_domain(dataset, np.arange(dataset.num_frames)))


@pytest.fixture(scope="module")
def trials_of(real_data: Path, tmp_path_factory: pytest.TempPathFactory) -> TrialsOf:
    """The trials of a mount before some walls, imported once for all laws."""
    out = tmp_path_factory.mktemp("trials")

    @cache
    def trials(mount: str, walls: tuple[str, ...]) -> Recording:
        parts = [read_trial(real_data, wall, mount) for wall in walls]
        poses, depth = (np.concatenate(part) for part in zip(*parts, strict=True))
        targets = np.repeat(walls, [len(own) for own, _ in parts])
        where = out / f"{mount}_{'_'.join(walls)}"
        recording, report = imported(where, ONE_PIXEL, poses, depth[:, None, None], None, targets)
        assert [wall["name"] for wall in report["walls"]] == list(walls)
        assert "w_z of the hand-eye" in report["undetermined"]
        return recording

    return trials


def origin(result: Fit) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return origin and covariance of the hand-eye in the tool frame (mm), and the ray."""
    transform = result.solution.parameters.tool_from_camera.numpy()
    rotation = transform[:3, :3]
    covariance = rotation @ result.covariance.matrix[:3, :3].numpy() @ rotation.T
    return 1e3 * transform[:3, 3], 1e6 * covariance, rotation[:, 2]


EVERY_TRIAL = pytest.param(MOUNTS, WALLS, marks=pytest.mark.slow)


# What a sensor of one ray can tell is held by the two quick tests around this one.
@pytest.mark.parametrize(("mounts", "walls"), [EVERY_TRIAL])
def test_the_origin_of_a_real_mount_repeats_across_its_ray_from_wall_to_wall(
    trials_of: TrialsOf, mounts: tuple[str, ...], walls: tuple[str, ...]
) -> None:
    scores = []
    for mount in mounts:
        together = fitted(trials_of(mount, WALLS), degree=1)
        assert {"w_z"} <= {
            name for one in together.observability.undetermined for name in one.shares
        }
        place, covariance, ray = origin(together)
        for wall in walls:
            alone = fitted(trials_of(mount, (wall,)), degree=1)
            own_place, own_covariance, own_ray = origin(alone)
            # Along the ray a shift is a constant error of the distance: compared across it.
            apart = own_place - place
            apart = apart - own_ray * (apart @ ray) / (own_ray @ ray)
            for axis in np.eye(3)[:2]:
                across, own_across = (
                    axis - (axis @ one) * one / np.linalg.norm(one) for one in (ray, own_ray)
                )
                variance = across @ covariance @ across + own_across @ own_covariance @ own_across
                scores.append(float(apart @ axis / np.sqrt(variance)))
    # Of 16 comparisons one may be beyond two standard errors: the wall R1 at the mount P1.
    beyond = [score for score in scores if abs(score) > REPEATABLE]
    assert len(scores) == 2 * len(mounts) * len(walls)
    assert len(beyond) <= len(scores) / 16
    assert max(map(abs, scores)) < 3.0


@pytest.mark.parametrize(("mounts", "walls"), [(("P2",), ("W1",)), EVERY_TRIAL])
def test_three_real_walls_predict_the_distances_to_the_fourth(
    trials_of: TrialsOf, mounts: tuple[str, ...], walls: tuple[str, ...]
) -> None:
    held_out, nearer = {}, {}
    for mount in mounts:
        recording = trials_of(mount, WALLS)
        dataset, depth = Dataset((recording,)), np.array(recording.depth)[:, 0, 0]
        for wall in walls:
            train = np.flatnonzero(dataset.targets != wall)
            test = np.flatnonzero(dataset.targets == wall)
            model = fitted(recording, degree=2, frames=train).model
            held_out[mount, wall] = _rms_alone(dataset, test, model)
            inside = test[depth[test] <= depth[train].max()]
            nearer[mount, wall] = _rms_alone(dataset, inside, model)
    # Seven poses of this trial are up to 200 mm farther from the wall than any other pose: there
    # the fitted curve is extended.
    farther = held_out.pop(("P2", "W1"))
    assert max(held_out.values(), default=0.0) <= 1.6
    assert nearer["P2", "W1"] <= 1.6
    assert farther <= 1.7


def _rms_alone(dataset: Dataset, frames: np.ndarray, model: CalibrationModel) -> float:
    """Return the RMS distance to a wall whose plane alone is estimated in these frames, mm."""
    found = walls_alone(dataset, frames, model)
    return _rms_mm(found.put_into(dataset), frames, model)


def _rms_mm(dataset: Dataset, frames: np.ndarray, model: CalibrationModel) -> float:
    residuals = []
    for batch in dataset.batches(frames):
        with torch.no_grad():
            residual = model.residual(
                batch.radial_distance,
                batch.amplitude,
                dataset.ray_directions(),
                batch.normal_tool,
                batch.offset_tool,
                batch.conditions,
            )
        residuals.append(residual.flatten())
    return 1e3 * float(torch.cat(residuals).square().mean().sqrt())
