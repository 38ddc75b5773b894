"""A training writes what it reports, and leaves nothing else."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure
from running import Program
from simulated_walls import simulated_wall
from training.trained import CONFIG, FILES, Trained, without_times

import tofcorr
from tofcorr import CalibrationDataError, Recording
from tofcorr.training.calibration import TrainingOptions


def test_held_out_images_do_not_move_the_window_of_outliers(
    trained: Trained, tmp_path: Path
) -> None:
    """Its centre was the median raw error of all images."""
    options = CONFIG | {"outlier_window_mm": 60.0, "advice": 0}
    shutil.copytree(trained.recording, tmp_path / "moved")
    depth = np.load(tmp_path / "moved" / "depth.npy")
    depth[trained.result.calibration.test] += np.float32(0.1)
    np.save(tmp_path / "moved" / "depth.npy", depth)
    # Half of the frames moved by 100 mm is what an inspection stops.
    first, second = (
        tofcorr.train(one, options, force=True) for one in (trained.recording, tmp_path / "moved")
    )
    one, other = (each.fit.solution.parameters.coefficients for each in (first, second))
    assert torch.equal(one, other)
    assert first.report["hand_eye"] == second.report["hand_eye"]


def test_the_run_folder_holds_its_files_and_nothing_else(trained: Trained) -> None:
    assert {path.name for path in trained.folder.iterdir()} == FILES
    assert len(list((trained.folder / "tb").glob("events.out.tfevents.*"))) == 1
    siblings = {path.name for path in trained.folder.parent.iterdir()}
    assert siblings == {"run", "wall"}


def test_the_run_is_on_disk_before_a_figure_is_drawn(
    trained: Trained, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(_: Any) -> None:
        raise RuntimeError("no figures today")

    monkeypatch.setattr("tofcorr.training.page.frames_to_show", fail)
    with pytest.raises(RuntimeError, match="no figures today"):
        tofcorr.train(trained.recording, CONFIG, out=tmp_path / "run")
    written = {path.name for path in (tmp_path / "run").iterdir()}
    assert written == FILES - {"report.html", "tb"}
    assert json.loads((tmp_path / "run" / "report.json").read_text())["stopped"] == "converged"


def test_the_report_on_disk_is_the_results_and_says_where_the_time_went(trained: Trained) -> None:
    seconds = trained.report()["seconds"]
    assert list(seconds) == ["read", "inspect", "fit", "report", "write", "figures"]
    assert all(value >= 0 for value in seconds.values())
    assert trained.report() == trained.result.report


def test_the_report_keeps_its_contract(trained: Trained) -> None:
    report = trained.report()
    assert (report["format"], report["version"]) == ("tofcorr-report", 1)
    assert (report["model"], report["stopped"]) == ("EA", "converged")
    assert report["iterations"] == trained.result.iterations[-1].iterations > 0
    assert list(report["error_mm"]) == ["before", "hand_eye_only", "after"]
    for halves in report["error_mm"].values():
        assert list(halves) == ["train", "test"]
        assert all(0 < errors["mean_abs"] < errors["rms"] for errors in halves.values())
    assert np.array(report["hand_eye"]["tool_from_camera"]).shape == (4, 4)
    for name in ("translation_se_mm", "rotation_se_deg"):
        assert len(report["hand_eye"][name]) == 3
    assert all(isinstance(warning, str) for warning in report["warnings"])
    assert len(report["advice"]["poses"]) == 2


def test_the_halves_share_no_frame_and_no_pose(trained: Trained) -> None:
    train, test = (trained.report()["frames"][half] for half in ("train", "test"))
    assert sorted([*train, *test]) == list(range(trained.data.num_frames))
    poses = trained.data.pose_groups()
    assert not set(poses[train]) & set(poses[test])
    assert len(set(poses[test])) == round(0.4 * len(set(poses)))


def test_the_resolved_configuration_trains_the_same_model(trained: Trained) -> None:
    again = tofcorr.train(trained.recording, trained.folder / "config.yaml")
    assert without_times(again.report) == without_times(trained.report())


def test_nothing_is_written_until_asked(
    trained: Trained, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    result = tofcorr.train([Recording.open(trained.recording)], TrainingOptions(**CONFIG))
    assert list(tmp_path.iterdir()) == []
    result.save(tmp_path / "saved")
    assert {path.name for path in (tmp_path / "saved").iterdir()} == FILES
    saved = json.loads((tmp_path / "saved" / "report.json").read_text())
    assert without_times(saved) == without_times(trained.report())
    for name in ("calibration.yaml", "config.yaml"):
        assert (tmp_path / "saved" / name).read_text() == (trained.folder / name).read_text()


def test_the_command_prints_the_result(trained: Trained, tmp_path: Path, program: Program) -> None:
    given = ("--config", trained.folder / "config.yaml", "--recording", trained.recording)
    told = program("train", *given, "--out", tmp_path / "run")
    code, printed, said = told
    assert (code, said) == (0, "")
    *found, last = printed.splitlines()
    assert "\n".join(found) == repr(trained.result)
    assert len(found) <= 11
    assert last.startswith(f"Written to {tmp_path / 'run'}: ")
    assert "report.json" in last


def test_verbose_prints_all_that_the_training_says(
    trained: Trained, tmp_path: Path, program: Program
) -> None:
    given = ("--config", trained.folder / "config.yaml", "--recording", trained.recording)
    _, printed, logged = program("train", "--verbose", *given, "--out", tmp_path / "run")
    assert printed.startswith(trained.result.details)
    assert "training: fit" in logged


def test_the_text_holds_the_errors_and_the_hand_eye(trained: Trained) -> None:
    lines = repr(trained.result).splitlines()
    assert lines[0].startswith(f"Verdict: {trained.report()['verdict']}.")
    for line, (stage, halves) in zip(lines[2:], trained.report()["error_mm"].items(), strict=False):
        *name, fitted, held_out = line.split()
        assert "_".join(name).replace("-", "_") == stage
        assert [fitted, held_out] == [f"{halves[half]['rms']:.2f}" for half in halves]
        assert f"{halves['test']['mean_abs']:.2f}" in trained.result.details
    assert "hand-eye translation, mm" in lines[5]


def test_figures_are_returned_and_an_unknown_covariate_is_refused(trained: Trained) -> None:
    for name in ("distance", "amplitude", "row", "column", "angle of incidence"):
        assert isinstance(trained.result.plot_profile(name), Figure)
    before, *_ = trained.result.plot_residuals().axes
    assert len(before.get_yticklabels()) == 5
    with pytest.raises(CalibrationDataError, match=r"'heat'.*distance, row, column, amplitude"):
        trained.result.plot_profile("heat")


def test_a_run_is_not_saved_into_an_existing_folder(trained: Trained, tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "mine.txt").write_text("keep")
    with pytest.raises(CalibrationDataError, match="exists already and is not overwritten"):
        trained.result.save(tmp_path / "run")
    assert [path.name for path in tmp_path.rglob("*")] == ["run", "mine.txt"]


def test_a_fit_that_fails_leaves_no_folder(trained: Trained, tmp_path: Path) -> None:
    silent = tmp_path / "wall"
    simulated_wall(silent, shots=(("white", 6),), conditions={"recorded": ["pose_id"]})
    needy = {**CONFIG, "model": {"terms": [{"kind": "integration_time"}]}}
    with pytest.raises(CalibrationDataError, match="integration_time"):
        tofcorr.train(silent, needy, out=tmp_path / "new" / "run")
    assert list(tmp_path.iterdir()) == [silent]
