"""Held-out errors: of the right model, on the right frames, with honest intervals."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from comparison.evaluated import compared, options
from synthetic_scene import Scene, write_scene

from tofcorr.comparison.experiment import Experiment
from tofcorr.comparison.options import BEFORE, HAND_EYE_ONLY
from tofcorr.correction.model import CalibrationModel, HandEye
from tofcorr.error_terms.base import Domain
from tofcorr.error_terms.model import ErrorModel, ErrorModelOptions
from tofcorr.errors import CalibrationDataError
from tofcorr.fit.fitting import fit
from tofcorr.geometry.rays import plane_in_frame, ray_plane_distance
from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.lattice import covered_domain
from tofcorr.pixels.passes import frame_errors
from tofcorr.training.calibration import TrainingOptions


def planes_in_camera(scene: Scene) -> tuple[torch.Tensor, torch.Tensor]:
    batch = scene.batch
    to_camera = scene.truth.tool_from_camera.expand(len(batch.normal_tool), 4, 4)
    return plane_in_frame(batch.normal_tool, batch.offset_tool, to_camera)


@pytest.fixture
def domain(dataset: Dataset) -> Domain:
    return covered_domain(dataset, np.arange(dataset.num_frames))


def test_every_split_is_measured_as_a_training_on_its_frames_would_be(
    dataset: Dataset, evaluation: Experiment, domain: Domain
) -> None:
    for protocol, values in evaluation.values.items():
        test = list(evaluation.splits[protocol].values())[-1]
        train = np.setdiff1d(np.arange(dataset.num_frames), test)
        for named in options().models:
            trained = fit(dataset, train, TrainingOptions(name="x", model=named.model), domain)
            expected = frame_errors(dataset, {"x": trained.model})["x"]["to_plane"]
            found = [values[metric][named.name][-1] for metric in ("mean_abs_mm", "rms_mm")]
            # Both fits end within a millionth of a standard error of the optimum.
            assert found == pytest.approx([expected.mean_abs_mm(test), expected.rms_mm(test)], 1e-6)
            if protocol == "half":
                white = test[dataset.targets[test] == "white"]
                by_wall = evaluation.by_wall("half")["white"][named.name]
                assert by_wall == pytest.approx(expected.rms_mm(white), 1e-6)


def test_before_has_no_correction_and_hand_eye_only_no_term(
    dataset: Dataset, evaluation: Experiment, domain: Domain
) -> None:
    hand_eye = HandEye(dataset.first.tool_from_camera)
    bare = CalibrationModel(ErrorModel(ErrorModelOptions(), domain), hand_eye)
    test = evaluation.splits["half"]["half"]
    expected = frame_errors(dataset, {"bare": bare})["bare"]["to_plane"].mean_abs_mm(test)
    found = evaluation.values["half"]["mean_abs_mm"]
    assert found[BEFORE][0] == pytest.approx(expected, rel=1e-12)
    assert found["EA"][0] < found[HAND_EYE_ONLY][0] < found[BEFORE][0]
    train = np.setdiff1d(np.arange(dataset.num_frames), evaluation.splits["half"]["half"])
    none = TrainingOptions(name="x", model=ErrorModelOptions())
    alone = fit(dataset, train, none, domain).hand_eye_only.tool_from_camera
    np.testing.assert_allclose(evaluation.hand_eye[HAND_EYE_ONLY], alone, atol=1e-6)


def test_errors_along_the_ray_and_in_z_are_those_of_the_true_distance(
    scene: Scene, dataset: Dataset
) -> None:
    """With the true hand-eye, measured minus true is known without any plane."""
    recording = dataset.first
    known = replace(recording, tool_from_camera=scene.truth.tool_from_camera.numpy())
    found = compared("wall", Dataset((known,)), options(folds=0))
    test = found.splits["half"]["half"]
    true = ray_plane_distance(scene.rays, *planes_in_camera(scene))
    error = (torch.from_numpy(np.array(recording.depth)).double() - true)[test]
    z, used = scene.rays[..., 2], scene.batch.valid[test]
    expected = [1e3 * float(one[used].square().mean().sqrt()) for one in (error, z * error)]
    values = found.values["half"]
    seen = [values[metric][BEFORE][0] for metric in ("rms_along_ray_mm", "rms_z_mm")]
    assert seen == pytest.approx(expected, rel=1e-6)


def test_poses_are_never_parted_and_folds_hold_out_every_frame_once(
    dataset: Dataset, evaluation: Experiment
) -> None:
    pose = dataset.pose_groups()
    splits = evaluation.splits
    for drawn in splits.values():
        for test in drawn.values():
            assert not set(pose[test]) & set(np.delete(pose, test))
    held_out = np.concatenate(list(splits["folds"].values()))
    assert sorted(held_out) == list(range(dataset.num_frames))
    repeats = splits["repeats"].values()
    assert len(repeats) == 3
    assert len({tuple(test) for test in repeats}) == 3
    assert all(len(test) == 8 for test in repeats)


def test_the_same_seed_draws_the_same_splits_and_another_seed_others(
    dataset: Dataset, evaluation: Experiment
) -> None:
    asked = options(repeats={"number": 3, "test_fraction": 0.25})
    other, _ = asked.model_copy(update={"seed": 1}).splits(dataset)
    for protocol, own in asked.splits(dataset)[0].items():
        for name, test in own.items():
            assert np.array_equal(test, evaluation.splits[protocol][name])
            assert not np.array_equal(test, other[protocol][name])


def test_the_model_that_made_the_errors_is_significantly_better(
    evaluation: Experiment,
) -> None:
    difference = evaluation.estimate("folds", "mean_abs_mm", "E0", less="EA")
    assert difference.significant
    assert difference.mean > 0
    # What is left to EA is the noise: 2 mm along the ray.
    assert evaluation.estimate("folds", "rms_along_ray_mm", "EA").mean == pytest.approx(2, rel=0.1)


def test_without_a_robot_hand_eye_only_is_before(scene: Scene, tmp_path: Path) -> None:
    recording = write_scene(scene, tmp_path / "wall")
    normal, offset = (one.numpy() for one in planes_in_camera(scene))
    poses = np.repeat(np.eye(4)[None], 32, axis=0)
    still = replace(recording.frames, world_from_tool=poses, normal_world=normal, offset=offset)
    found = compared("wall", Dataset((replace(recording, frames=still),)), options())
    assert not found.hand_eye_estimated
    values = found.values["folds"]["mean_abs_mm"]
    np.testing.assert_allclose(values[BEFORE], values[HAND_EYE_ONLY], rtol=1e-12)
    assert found.hand_eye["EA"] == np.eye(4).tolist()


def test_too_few_poses_are_refused_and_fits_that_do_not_converge_told(
    dataset: Dataset,
) -> None:
    with pytest.raises(CalibrationDataError, match="16 poses cannot be divided into 17 folds"):
        Experiment("wall", dataset, options(folds=17))
    found = compared("wall", dataset, options(folds=0, solver={"max_iterations": 1}))
    assert len(found.warnings) == 3
    assert "Not converged" in found.warnings[0]
