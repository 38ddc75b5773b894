"""Commands stop at what cannot be, head their reports with what is doubtful, and judge a run."""

import json
from pathlib import Path

import numpy as np
import pytest
from running import Program
from shown_pages import fetched, silent

import tofcorr
from benchmarks.wrong_recordings.parts import Parts
from benchmarks.wrong_recordings.table import FURTHER, TABLE
from tofcorr.comparison.experiment import without_frames
from tofcorr.options import resolve_options
from tofcorr.training.calibration import TrainingOptions

E0 = {"name": "E0", "model": {"terms": []}, "advice": 0, "figures": False}


@pytest.fixture(scope="module")
def flipped(parts: Parts, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("flipped") / "recording"
    return TABLE["normals flipped"](parts, np.random.default_rng(0)).write(folder)


@pytest.mark.parametrize("command", ["train", "evaluate", "select", "diagnose"])
def test_every_command_stops_with_one_sentence_and_writes_nothing(
    command: str, flipped: Path, tmp_path: Path, program: Program
) -> None:
    out = tmp_path / "out"
    code, _, told = program(command, "--recording", flipped, "--out", out)
    assert code == 2
    assert "point away from the camera in all frames" in told
    assert told.count("\n") == 1
    assert not out.exists()


def test_inspect_prints_the_findings_and_writes_one_page(
    flipped: Path, tmp_path: Path, program: Program
) -> None:
    page = tmp_path / "page.html"
    code, told, _ = program("inspect", flipped, "--out", page)
    assert code == 0
    assert "impossible The normals of the planes point away" in told
    text = page.read_text(encoding="utf-8")
    assert text.count("<svg") == 3
    assert "point away from the camera" in text
    assert (fetched(text), silent(text)) == ([], 0)
    assert (
        "a name that ends in .html" in program("inspect", flipped, "--out", tmp_path / "page").err
    )


def test_evaluate_and_select_leave_out_the_frames_that_a_training_leaves_out(
    parts: Parts, tmp_path: Path
) -> None:
    """One pose 100 mm off: the tables of `evaluate` contradicted the report of `train`."""
    poses = parts.poses.copy()
    poses[3, :3, 3] += 0.1 * parts.normal[3]
    wrong = parts.changed(poses=poses).write(tmp_path / "wrong")
    training = tofcorr.train(wrong, E0)
    trained = training.report
    assert [one["frame"] for one in trained["left_out"]] == [3]
    assert trained["left_out"][0]["off_mm"] == pytest.approx(100, abs=15)
    assert 3 not in (*trained["frames"]["train"], *trained["frames"]["test"])
    assert "Doubtful recording: Frame 3 disagrees with all others" in repr(training)
    models = {"models": [{"name": "E0", "model": {"terms": []}}]}
    evaluated, selected = tofcorr.evaluate(wrong, models), tofcorr.select(wrong, models)
    found = evaluated.to_mapping()["sets"][0]
    half = found["held_out"]["half"]
    assert found["left_out"] == selected.to_mapping()["left_out"] == trained["left_out"]
    assert half["test_frames"] == [trained["frames"]["test"]]
    error = half["error_mm"]["mean_abs_mm"]["E0"]["mean"]
    assert error == pytest.approx(trained["error_mm"]["after"]["test"]["mean_abs"], rel=1e-6)
    assert selected.decisive.errors["E0"].mean < 1.5 * error
    for result in (training, evaluated, selected):
        assert "Frame 3 is left out of all fits and errors" in result.details


def test_a_fold_that_held_out_nothing_but_left_out_frames_is_dropped() -> None:
    kept = without_frames({"first": np.array([0]), "second": np.array([0, 2, 3])}, [0])
    assert {name: test.tolist() for name, test in kept.items()} == {"second": [2, 3]}


def test_a_forced_run_is_not_to_be_used_and_has_a_corrector_all_the_same(
    parts: Parts, tmp_path: Path
) -> None:
    folder = TABLE["planes 40 deg off"](parts, np.random.default_rng(3)).write(tmp_path / "wrong")
    forced = tofcorr.train(folder, E0, out=tmp_path / "run", force=True)
    assert forced.report["verdict"] == "do not use"
    assert (tmp_path / "run" / "corrector.ts").exists()


def test_without_force_a_run_not_to_be_used_has_no_corrector(parts: Parts, tmp_path: Path) -> None:
    folder = TABLE["planes 5 deg off"](parts, np.random.default_rng(3)).write(tmp_path / "wrong")
    tofcorr.train(folder, E0, out=tmp_path / "run")
    report = json.loads((tmp_path / "run" / "report.json").read_text(encoding="utf-8"))
    assert report["verdict"] == "do not use"
    assert not (tmp_path / "run" / "corrector.ts").exists()
    assert (tmp_path / "run" / "calibration.yaml").exists()


def test_a_clean_run_is_good_and_says_against_what(clean: Path) -> None:
    report = tofcorr.train(clean, "ea").report
    assert (report["left_out"], report["headline"]) == ([], None)
    assert report["verdict"] in ("good", "usable")
    assert "mm with the hand-eye alone" in report["reason"]


@pytest.mark.slow
def test_garbage_pixels_hardly_move_the_hand_eye(parts: Parts, tmp_path: Path) -> None:
    spoilt = TABLE["30 % garbage pixels"](parts, np.random.default_rng(5))
    found = tofcorr.train(spoilt.write(tmp_path / "spoilt"), E0).report
    right = tofcorr.train(parts.write(tmp_path / "right"), E0).report
    places = [np.array(one["hand_eye"]["tool_from_camera"])[:3, 3] for one in (found, right)]
    # Robust weights lower the efficiency; without them the place moves by centimetres.
    assert np.linalg.norm(places[0] - places[1]) < 4e-3


def test_a_diagnosis_of_one_pixel_is_refused_in_words(parts: Parts, tmp_path: Path) -> None:
    folder = TABLE["1 x 1 pixels"](parts, np.random.default_rng(0)).write(tmp_path / "one")
    with pytest.raises(tofcorr.CalibrationDataError, match="compares neighbouring pixels"):
        tofcorr.diagnose(folder)


@pytest.mark.parametrize("draw", [0, *(pytest.param(i, marks=pytest.mark.slow) for i in (1, 2))])
def test_five_frames_end_in_a_verdict_not_in_a_traceback(
    draw: int, parts: Parts, tmp_path: Path
) -> None:
    folder = TABLE["five frames"](parts, np.random.default_rng(draw)).write(tmp_path / "five")
    # Where the solver ends does not matter: it would take two hundred steps.
    ea = resolve_options(TrainingOptions, "ea", ["solver.max_iterations=20", "figures=false"])
    report = tofcorr.train(folder, ea).report
    assert report["verdict"] == "do not use"
    json.dumps(report, allow_nan=False)


@pytest.mark.slow
def test_a_check_of_poses_that_never_change_is_refused_in_words(
    clean: Path, parts: Parts, tmp_path: Path
) -> None:
    tofcorr.train(clean, E0, out=tmp_path / "run", force=True)
    still = TABLE["all poses the same"](parts, np.random.default_rng(0)).write(tmp_path / "still")
    with pytest.raises(tofcorr.CalibrationDataError, match="no camera drifts so far"):
        tofcorr.check(tmp_path / "run", still, wall="recorded")


@pytest.mark.slow
def test_an_amplitude_of_one_value_heads_a_diagnosis(parts: Parts, tmp_path: Path) -> None:
    flat = FURTHER["amplitude of one value"](parts, np.random.default_rng(0))
    folder = flat.write(tmp_path / "flat")
    found = tofcorr.diagnose(folder, config={"bootstraps": 19, "simulate_anew": False})
    assert found.verdict.startswith("Doubtful recording: The amplitude is 100 nearly everywhere")
