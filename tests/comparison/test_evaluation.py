"""Held-out errors: of the right model, on the right frames, with honest intervals."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from comparison.evaluated import MODELS, options
from synthetic_scene import Scene, write_scene

from tofcorr.comparison.evaluate import evaluate_set
from tofcorr.comparison.experiment import Experiment
from tofcorr.comparison.options import BEFORE, HAND_EYE_ONLY
from tofcorr.correction.model import CalibrationModel, HandEye
from tofcorr.error_terms.base import Domain
from tofcorr.error_terms.model import ErrorModel, ErrorModelOptions
from tofcorr.errors import CalibrationDataError
from tofcorr.fit.fitting import fit, fit_hand_eye
from tofcorr.pixels.dataset import Dataset, covered_domain
from tofcorr.pixels.metrics import frame_errors
from tofcorr.training.calibration import TrainingOptions


@pytest.fixture
def domain(dataset: Dataset) -> Domain:
    return covered_domain(dataset, np.arange(dataset.num_frames))


def test_every_split_is_measured_as_a_training_on_its_frames_would_be(
    dataset: Dataset, evaluation: Experiment, domain: Domain
) -> None:
    for protocol in ("half", "folds", "repeats"):
        values = evaluation.values[protocol]
        test = list(evaluation.splits[protocol].values())[-1]
        train = np.setdiff1d(np.arange(dataset.num_frames), test)
        for named in options().models:
            trained = fit(dataset, train, TrainingOptions(name="x", model=named.model), domain)
            expected = frame_errors(dataset, {"x": trained.model}, test)["x"]
            mean_abs = values["mean_abs_mm"][named.name][-1]
            rms = values["rms_mm"][named.name][-1]
            # Both fits end within a millionth of a standard error of the optimum.
            assert mean_abs == pytest.approx(expected.mean_abs_mm(), rel=1e-6)
            assert rms == pytest.approx(expected.rms_mm(), rel=1e-6)


def test_before_is_the_recorded_hand_eye_without_correction(
    dataset: Dataset, evaluation: Experiment, domain: Domain
) -> None:
    hand_eye = HandEye(dataset.first.tool_from_camera)
    bare = CalibrationModel(ErrorModel(ErrorModelOptions(), domain), hand_eye)
    test = evaluation.splits["half"]["half"]
    expected = frame_errors(dataset, {"bare": bare}, test)["bare"].mean_abs_mm()
    found = evaluation.values["half"]["mean_abs_mm"]
    assert found[BEFORE][0] == pytest.approx(expected, rel=1e-12)
    assert found["EA"][0] < found[HAND_EYE_ONLY][0] < found[BEFORE][0]


def test_hand_eye_only_is_the_fit_of_the_hand_eye_without_any_term(
    dataset: Dataset, evaluation: Experiment, domain: Domain
) -> None:
    train = np.setdiff1d(np.arange(dataset.num_frames), evaluation.splits["half"]["half"])
    alone = fit_hand_eye(
        dataset, train, TrainingOptions(name="x", model=ErrorModelOptions()), domain
    )
    found = evaluation.hand_eye[HAND_EYE_ONLY]
    np.testing.assert_allclose(found, alone.tool_from_camera, atol=1e-6)


def test_errors_along_the_ray_and_in_z_are_those_of_the_true_distance(
    scene: Scene, dataset: Dataset
) -> None:
    """With the true hand-eye, measured minus true is known without any plane."""
    recording = dataset.first
    known = replace(recording, tool_from_camera=scene.truth.tool_from_camera.numpy())
    found = evaluate_set("wall", Dataset((known,)), options(folds=0))
    test = found.splits["half"]["half"]
    cosine = scene.batch.normal_tool @ scene.truth.tool_from_camera[:3, :3]
    to_plane = torch.einsum("hwk,nk->nhw", scene.rays, cosine)
    origin = scene.batch.normal_tool @ scene.truth.tool_from_camera[:3, 3]
    true = -(origin + scene.batch.offset_tool)[:, None, None] / to_plane
    error = (torch.from_numpy(np.array(recording.depth)).double() - true)[test]
    used = scene.batch.valid[test]
    z = scene.rays[..., 2].expand_as(error)[used]
    along_ray = 1e3 * float(error[used].square().mean().sqrt())
    in_z = 1e3 * float((z * error[used]).square().mean().sqrt())
    values = found.values["half"]
    assert values["rms_along_ray_mm"][BEFORE][0] == pytest.approx(along_ray, rel=1e-6)
    assert values["rms_z_mm"][BEFORE][0] == pytest.approx(in_z, rel=1e-6)


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


@pytest.mark.slow
def test_the_same_seed_gives_the_same_figures_and_another_seed_others(
    dataset: Dataset, evaluation: Experiment
) -> None:
    asked = options(repeats={"number": 3, "test_fraction": 0.25}, models=MODELS[:1])
    again = evaluate_set("wall", dataset, asked)
    other = evaluate_set("wall", dataset, asked.model_copy(update={"seed": 1}))
    for protocol, metrics in again.values.items():
        for metric, columns in metrics.items():
            for column, values in columns.items():
                assert np.array_equal(values, evaluation.values[protocol][metric][column])
                assert not np.array_equal(values, other.values[protocol][metric][column])


def test_models_side_by_side_are_what_each_is_alone(
    dataset: Dataset, evaluation: Experiment
) -> None:
    alone = evaluate_set("wall", dataset, options(models=[MODELS[0]]))
    for metric in ("mean_abs_mm", "rms_mm"):
        values = alone.values["folds"][metric]
        together = evaluation.values["folds"][metric]
        for column in (BEFORE, HAND_EYE_ONLY, "E0"):
            np.testing.assert_allclose(values[column], together[column], rtol=1e-6)


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
    table = recording.frames
    still = replace(
        table,
        world_from_tool=np.broadcast_to(np.eye(4), (32, 4, 4)).copy(),
        normal_world=(scene.batch.normal_tool @ scene.truth.tool_from_camera[:3, :3]).numpy(),
        offset=(
            scene.batch.normal_tool @ scene.truth.tool_from_camera[:3, 3] + scene.batch.offset_tool
        ).numpy(),
    )
    found = evaluate_set("wall", Dataset((replace(recording, frames=still),)), options())
    assert not found.hand_eye_estimated
    values = found.values["folds"]["mean_abs_mm"]
    np.testing.assert_allclose(values[BEFORE], values[HAND_EYE_ONLY], rtol=1e-12)
    assert found.hand_eye["EA"] == np.eye(4).tolist()


def test_too_few_poses_for_the_folds_are_refused(dataset: Dataset) -> None:
    with pytest.raises(CalibrationDataError, match="16 poses cannot be divided into 17 folds"):
        evaluate_set("wall", dataset, options(folds=17))


def test_a_fit_that_does_not_converge_is_told(dataset: Dataset) -> None:
    found = evaluate_set("wall", dataset, options(folds=0, solver={"max_iterations": 1}))
    assert len(found.warnings) == 3
    assert "Not converged" in found.warnings[0]


def test_a_model_that_needs_amplitudes_refuses_a_recording_without(
    scene: Scene, tmp_path: Path
) -> None:
    recording = write_scene(scene, tmp_path / "wall", amplitude=None)
    with pytest.raises(CalibrationDataError, match=r"amplitude\.npy is missing"):
        evaluate_set("wall", Dataset((recording,)), options())
    geometric = evaluate_set("wall", Dataset((recording,)), options(models=[MODELS[0]], folds=0))
    assert geometric.estimate("half", "rms_mm", "E0").mean > 0
