"""Held-out errors: of the right model, on the right frames, with honest intervals."""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from click.testing import CliRunner
from scipy import stats
from synthetic_scene import E0, EA, EB, Scene, make_scene, write_scene

from tofcorr.cli.evaluate import command
from tofcorr.comparison.evaluate import set_names
from tofcorr.comparison.evaluation import SetEvaluation, evaluate_set, main_pairs, pairs
from tofcorr.comparison.evaluation_options import BEFORE, HAND_EYE_ONLY, EvaluationOptions
from tofcorr.comparison.evaluation_report import (
    evaluation_mapping,
    evaluation_text,
    write_evaluation,
)
from tofcorr.comparison.evaluation_tables import tables
from tofcorr.comparison.split_statistics import over_folds, over_repeats
from tofcorr.correction.hand_eye import HandEye
from tofcorr.correction.model import CalibrationModel
from tofcorr.error_terms.model import ErrorModel, ErrorModelOptions
from tofcorr.errors import CalibrationDataError, ConfigError
from tofcorr.fit.fitting import fit
from tofcorr.options import dump_yaml
from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.domain import covered_domain
from tofcorr.pixels.metrics import frame_errors
from tofcorr.pixels.outliers import without_outliers
from tofcorr.training.options import TrainingOptions

MODELS = [{"name": name, "model": model} for name, model in (("E0", E0), ("EA", EA), ("EB", EB))]


def options(**changes: Any) -> EvaluationOptions:
    return EvaluationOptions.from_mapping({"models": MODELS, "folds": 4} | changes, "test")


@pytest.fixture(scope="module")
def scene() -> Scene:
    return make_scene(torch.Generator().manual_seed(0), EA, num_frames=32, noise=0.002)


@pytest.fixture(scope="module")
def dataset(scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    folder = tmp_path_factory.mktemp("scene") / "wall"
    nearly = scene.truth.moved(torch.full((scene.truth.size,), 0.01).double())
    return Dataset((write_scene(scene, folder, nearly.tool_from_camera),))


@pytest.fixture(scope="module")
def evaluation(dataset: Dataset) -> SetEvaluation:
    return evaluate_set("wall", dataset, options(repeats={"number": 3, "test_fraction": 0.25}))


def test_every_split_is_measured_as_a_training_on_its_frames_would_be(
    dataset: Dataset, evaluation: SetEvaluation
) -> None:
    domain = covered_domain(dataset, np.arange(dataset.num_frames))
    for protocol in ("half", "folds", "repeats"):
        scores = evaluation.scores[protocol]
        split = scores.splits[-1]
        for named in options().models:
            trained = fit(
                dataset, split.train, TrainingOptions(name="x", model=named.model), domain
            )
            expected = frame_errors(dataset, {"x": trained.model}, split.test)["x"]
            mean_abs = scores.values["mean_abs_mm"][named.name][-1]
            rms = scores.values["rms_mm"][named.name][-1]
            # Both fits end within a millionth of a standard error of the optimum.
            assert mean_abs == pytest.approx(expected.mean_abs_mm(), rel=1e-6)
            assert rms == pytest.approx(expected.rms_mm(), rel=1e-6)


def test_before_is_the_recorded_hand_eye_without_correction(
    dataset: Dataset, evaluation: SetEvaluation
) -> None:
    domain = covered_domain(dataset, np.arange(dataset.num_frames))
    hand_eye = HandEye(dataset.first.tool_from_camera)
    bare = CalibrationModel(ErrorModel(ErrorModelOptions(), domain), hand_eye)
    test = evaluation.scores["half"].splits[0].test
    expected = frame_errors(dataset, {"bare": bare}, test)["bare"].mean_abs_mm()
    found = evaluation.scores["half"].values["mean_abs_mm"]
    assert found[BEFORE][0] == pytest.approx(expected, rel=1e-12)
    assert found["EA"][0] < found[HAND_EYE_ONLY][0] < found[BEFORE][0]


def test_errors_along_the_ray_and_in_z_are_those_of_the_true_distance(
    scene: Scene, dataset: Dataset
) -> None:
    """With the true hand-eye, measured minus true is known without any plane."""
    recording = dataset.first
    known = replace(recording, tool_from_camera=scene.truth.tool_from_camera.numpy())
    found = evaluate_set("wall", Dataset((known,)), options(folds=0))
    test = found.scores["half"].splits[0].test
    cosine = scene.batch.normal_tool @ scene.truth.tool_from_camera[:3, :3]
    to_plane = torch.einsum("hwk,nk->nhw", scene.rays, cosine)
    origin = scene.batch.normal_tool @ scene.truth.tool_from_camera[:3, 3]
    true = -(origin + scene.batch.offset_tool)[:, None, None] / to_plane
    error = (torch.from_numpy(np.array(recording.depth)).double() - true)[test]
    used = scene.batch.valid[test]
    z = scene.rays[..., 2].expand_as(error)[used]
    along_ray = 1e3 * float(error[used].square().mean().sqrt())
    in_z = 1e3 * float((z * error[used]).square().mean().sqrt())
    values = found.scores["half"].values
    assert values["rms_along_ray_mm"][BEFORE][0] == pytest.approx(along_ray, rel=1e-6)
    assert values["rms_z_mm"][BEFORE][0] == pytest.approx(in_z, rel=1e-6)


def test_poses_are_never_parted_and_folds_hold_out_every_frame_once(
    dataset: Dataset, evaluation: SetEvaluation
) -> None:
    pose = dataset.pose_groups()
    for scores in evaluation.scores.values():
        for split in scores.splits:
            assert not set(pose[split.train]) & set(pose[split.test])
            assert sorted([*split.train, *split.test]) == list(range(dataset.num_frames))
    held_out = np.concatenate([split.test for split in evaluation.scores["folds"].splits])
    assert sorted(held_out) == list(range(dataset.num_frames))
    repeats = evaluation.scores["repeats"].splits
    assert len(repeats) == 3
    assert len({tuple(split.test) for split in repeats}) == 3
    assert all(len(split.test) == 8 for split in repeats)


@pytest.mark.slow
def test_the_same_seed_gives_the_same_figures_and_another_seed_others(
    dataset: Dataset, evaluation: SetEvaluation
) -> None:
    asked = options(repeats={"number": 3, "test_fraction": 0.25}, models=MODELS[:1])
    again = evaluate_set("wall", dataset, asked)
    other = evaluate_set("wall", dataset, asked.model_copy(update={"seed": 1}))
    for protocol, scores in again.scores.items():
        for metric, columns in scores.values.items():
            for column, values in columns.items():
                first = evaluation.scores[protocol].values[metric][column]
                assert np.array_equal(values, first)
                assert not np.array_equal(values, other.scores[protocol].values[metric][column])


def test_models_side_by_side_are_what_each_is_alone(
    dataset: Dataset, evaluation: SetEvaluation
) -> None:
    alone = evaluate_set("wall", dataset, options(models=[MODELS[0]]))
    for metric in ("mean_abs_mm", "rms_mm"):
        values = alone.scores["folds"].values[metric]
        together = evaluation.scores["folds"].values[metric]
        for column in (BEFORE, HAND_EYE_ONLY, "E0"):
            np.testing.assert_allclose(values[column], together[column], rtol=1e-6)


def test_the_model_that_made_the_errors_is_significantly_better(
    evaluation: SetEvaluation,
) -> None:
    difference = evaluation.difference("folds", "mean_abs_mm", "E0", "EA")
    assert difference.significant
    assert difference.mean > 0
    # What is left to EA is the noise: 2 mm along the ray.
    assert evaluation.estimate("folds", "rms_along_ray_mm", "EA").mean == pytest.approx(2, rel=0.1)


def test_intervals_and_p_values_are_those_of_students_t() -> None:
    first, second = np.array([5.0, 7, 6, 9, 4, 8]), np.array([4.0, 6.5, 6, 7, 4.2, 6])
    found = over_folds(first - second)
    expected = stats.ttest_rel(first, second)
    assert found.p_value == pytest.approx(expected.pvalue)
    interval = expected.confidence_interval(0.95)
    assert found.mean - found.half_width == pytest.approx(interval.low)
    assert found.mean + found.half_width == pytest.approx(interval.high)
    # The paper's 2.57 standard errors are the t quantile of six folds.
    standard_error = np.std(first - second, ddof=1) / math.sqrt(6)
    assert found.half_width == pytest.approx(2.5706 * standard_error, rel=1e-4)


def test_overlapping_splits_get_wider_intervals_than_folds() -> None:
    values = np.array([3.0, 4, 5, 4, 3, 5])
    folds, repeats = over_folds(values), over_repeats(values, 0.25)
    # n_test / n_train = 1/3 is added to 1/6.
    assert repeats.half_width == pytest.approx(folds.half_width * math.sqrt(3.0))
    assert repeats.mean == folds.mean


def test_equal_columns_do_not_differ_and_one_split_has_no_interval() -> None:
    same = over_folds(np.zeros(6))
    assert (same.mean, same.p_value, same.significant) == (0.0, 1.0, False)
    single = over_folds(np.array([3.0]))
    assert single.mean == 3.0
    assert math.isnan(single.half_width)
    assert not single.significant


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
    values = found.scores["folds"].values["mean_abs_mm"]
    np.testing.assert_allclose(values[BEFORE], values[HAND_EYE_ONLY], rtol=1e-12)
    assert torch.equal(found.hand_eye["EA"], torch.eye(4).double())


def with_outliers(scene: Scene, *, masked: bool) -> dict[str, np.ndarray]:
    depth = scene.batch.radial_distance.float().numpy().copy()
    mask = np.ones_like(depth, dtype=np.uint8)
    depth[3, 2, 4:9] += 0.5
    depth[17, 5, 1:4] -= 0.4
    if masked:
        mask[3, 2, 4:9] = mask[17, 5, 1:4] = 0
    return {"depth": depth, "mask": mask}


def test_pixels_outside_the_window_count_as_masked_out(scene: Scene, tmp_path: Path) -> None:
    guess = scene.truth.tool_from_camera
    spoilt = write_scene(scene, tmp_path / "a", guess, **with_outliers(scene, masked=False))
    masked = write_scene(scene, tmp_path / "b", guess, **with_outliers(scene, masked=True))
    asked = options(models=MODELS[1:2], folds=2)
    window = asked.model_copy(update={"outlier_window_mm": 200.0})
    found = evaluate_set("a", Dataset((spoilt,)), window)
    expected = evaluate_set("b", Dataset((masked,)), window)
    unguarded = evaluate_set("c", Dataset((spoilt,)), asked)
    assert found.num_pixels == expected.num_pixels
    for column in asked.columns:
        values = found.scores["folds"].values["rms_mm"][column]
        # The domain that scales the variables has seen the outliers, the optimum has not.
        np.testing.assert_allclose(
            values, expected.scores["folds"].values["rms_mm"][column], rtol=1e-5
        )
    assert unguarded.estimate("folds", "rms_mm", "EA").mean > 2 * np.mean(
        found.scores["folds"].values["rms_mm"]["EA"]
    )


def test_the_window_lies_about_the_median_raw_error(scene: Scene, tmp_path: Path) -> None:
    far = scene.batch.radial_distance.float().numpy() + np.float32(0.3)
    dataset = Dataset(
        (write_scene(scene, tmp_path / "a", scene.truth.tool_from_camera, depth=far),)
    )
    kept = sum(int(batch.valid.sum()) for batch in without_outliers(dataset, 150.0).batches())
    assert kept == int(scene.batch.valid.sum())
    assert without_outliers(dataset, None) is dataset


def test_a_window_without_any_plane_in_sight_is_refused(scene: Scene, tmp_path: Path) -> None:
    about_face = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0])).double()
    guess = scene.truth.tool_from_camera @ about_face
    dataset = Dataset((write_scene(scene, tmp_path / "a", guess),))
    with pytest.raises(CalibrationDataError, match="outlier_window_mm needs pixels"):
        without_outliers(dataset, 80.0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"models": []}, "models"),
        ({"models": [MODELS[0], MODELS[0]]}, "two columns would be called 'E0'"),
        ({"models": [{"name": "before"}]}, "two columns would be called 'before'"),
        ({"folds": 1}, "one fold leaves nothing"),
        ({"fold": 6}, "Did you mean 'folds'"),
        ({"outlier_window_mm": -1.0}, "outlier_window_mm"),
    ],
)
def test_options_that_make_no_sense_are_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        options(**changes)


def test_too_few_poses_for_the_folds_are_refused(dataset: Dataset) -> None:
    with pytest.raises(CalibrationDataError, match="16 poses cannot be divided into 17 folds"):
        evaluate_set("wall", dataset, options(folds=17))


def test_a_fit_that_does_not_converge_is_told(dataset: Dataset) -> None:
    found = evaluate_set("wall", dataset, options(folds=0, solver={"max_iterations": 1}))
    assert len(found.warnings) == 3
    assert "Not converged" in found.warnings[0]


def test_sets_are_called_after_their_folders_and_numbered_where_alike() -> None:
    assert set_names(["/a/set1", "/b/set2"]) == ["set1", "set2"]
    assert set_names(["/a/wall", "/b/set", "/c/wall"]) == ["wall (1)", "set", "wall (3)"]


def test_pairs_leave_before_out_and_the_main_ones_are_a_chain_and_a_star() -> None:
    columns = [BEFORE, HAND_EYE_ONLY, "a", "b", "c"]
    assert len(pairs(columns)) == 6
    assert main_pairs(columns) == [
        (HAND_EYE_ONLY, "a"), ("a", "b"), ("a", "c"), ("b", "c"),
    ]  # fmt: skip


def test_tables_have_the_papers_layout(evaluation: SetEvaluation) -> None:
    asked = options(repeats={"number": 3, "test_fraction": 0.25})
    half, folds, *_ = tables([evaluation, evaluation], asked)
    for table in (half, folds):
        assert table.header == ["set", BEFORE, HAND_EYE_ONLY, "E0", "EA", "EB"]
        assert len(table.rows) == 2
    assert half.rows[0][0] == "wall (16 checkerboard, 16 white)"
    estimate = evaluation.estimate("folds", "mean_abs_mm", "EA")
    assert folds.rows[0][4] == f"{estimate.mean:.2f} ± {estimate.half_width:.2f}"
    lines = half.text().splitlines()
    assert len({line.index("before") + 6 for line in lines if "before" in line}) == 1
    assert len({len(line) for line in lines[2:6]}) == 1


def test_the_report_is_complete_and_holds_no_nan(evaluation: SetEvaluation, tmp_path: Path) -> None:
    asked = options(repeats={"number": 3, "test_fraction": 0.25})
    write_evaluation(tmp_path, [evaluation], asked)
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"evaluation.json", "evaluation.md", "comparison.png", "config.yaml", "tb"}
    assert "Table 1" in evaluation_text([evaluation], asked)
    content = json.loads((tmp_path / "evaluation.json").read_text(), parse_constant=pytest.fail)
    assert content == evaluation_mapping([evaluation], asked)
    folds = content["sets"][0]["held_out"]["folds"]
    assert len(folds["error_mm"]["rms_mm"]["EA"]["splits"]) == 4
    assert {test["degrees_of_freedom"] for test in folds["paired_tests"]} == {3}
    assert content["sets"][0]["held_out"]["half"]["error_mm"]["rms_mm"]["EA"]["ci"] == [None, None]


def run(tmp_path: Path, config: dict[str, Any], recording: Path, out: str = "report") -> Any:
    (tmp_path / "config.yaml").write_text(dump_yaml(config))
    arguments = ["--config", str(tmp_path / "config.yaml"), "--recording", str(recording)]
    return CliRunner().invoke(command, [*arguments, "--out", str(tmp_path / out)])


def test_the_command_writes_a_report_whole(dataset: Dataset, tmp_path: Path) -> None:
    result = run(tmp_path, {"models": MODELS[:1], "folds": 2}, dataset.first.path)
    assert result.exit_code == 0, result.output
    assert "Table 2" in result.output
    assert (tmp_path / "report" / "evaluation.json").is_file()
    assert options(folds=2, models=MODELS[:1]).num_fits == 3


@pytest.mark.parametrize(
    ("config", "kind"),
    [
        ({"models": MODELS, "folds": 40}, CalibrationDataError),
        ({"models": MODELS, "fold": 4}, ConfigError),
    ],
)
def test_the_command_leaves_nothing_behind_when_it_refuses(
    config: dict[str, Any], kind: type[Exception], dataset: Dataset, tmp_path: Path
) -> None:
    result = run(tmp_path, config, dataset.first.path)
    assert isinstance(result.exception, kind)
    assert [path.name for path in tmp_path.iterdir()] == ["config.yaml"]


def test_a_model_that_needs_amplitudes_refuses_a_recording_without(
    scene: Scene, tmp_path: Path
) -> None:
    recording = write_scene(scene, tmp_path / "wall", amplitude=None)
    with pytest.raises(CalibrationDataError, match=r"amplitude\.npy is missing"):
        evaluate_set("wall", Dataset((recording,)), options())
    geometric = evaluate_set("wall", Dataset((recording,)), options(models=[MODELS[0]], folds=0))
    assert geometric.estimate("half", "rms_mm", "E0").mean > 0
