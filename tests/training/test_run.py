"""A training writes what it reports, goes on where it was interrupted, and leaves nothing else."""

import json
import shutil
import signal
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from click.testing import CliRunner
from matplotlib.figure import Figure
from simulated_walls import simulated_wall, true_hand_eye
from torch import Tensor

import tofcorr
from tofcorr import CalibrationDataError, ConfigError, Recording, TrainingResult
from tofcorr.cli.train import command
from tofcorr.estimation.solution import Iteration
from tofcorr.pixels.dataset import Dataset
from tofcorr.training.interruption import interruptible
from tofcorr.training.monitor import RunMonitor
from tofcorr.training.options import TrainingOptions

CONFIG: dict[str, Any] = {
    "name": "EA",
    "model": {
        "terms": [
            {"kind": "distance_polynomial", "degree": 3},
            {"kind": "pixel_polynomial", "degree": 2},
            {"kind": "amplitude_polynomial", "variable": "amplitude", "degree": 2},
        ]
    },
    "split": {"test_fraction": 0.4, "seed": 3},
    "advice": 2,
}
FILES = {
    *("calibration.yaml", "config.yaml", "corrector.ts", "reference.json"),
    *("report.json", "state.pt", "tb"),
}


@dataclass(frozen=True)
class Trained:
    """One training of a simulated recording, and its run folder."""

    data: Dataset
    result: TrainingResult
    folder: Path

    @property
    def recording(self) -> Path:
        return self.data.first.path

    def report(self) -> dict[str, Any]:
        return json.loads((self.folder / "report.json").read_text())

    def calibration(self) -> dict[str, Any]:
        return yaml.safe_load((self.folder / "calibration.yaml").read_text())


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Trained:
    folder = tmp_path_factory.mktemp("trained")
    data = simulated_wall(folder / "wall", seed=7)
    result = tofcorr.train(data.first.path, CONFIG, out=folder / "run")
    return Trained(data, result, folder / "run")


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
    for one, other in zip(
        (first.calibration.fit.solution.parameters.coefficients, first.report["hand_eye"]),
        (second.calibration.fit.solution.parameters.coefficients, second.report["hand_eye"]),
        strict=True,
    ):
        assert torch.equal(one, other) if isinstance(one, Tensor) else one == other


def error_in_the_papers_symbols(
    groups: dict[str, dict[str, dict[str, float]]],
    distance: Tensor,
    amplitude: Tensor,
    row: Tensor,
    column: Tensor,
) -> Tensor:
    """Return c0 + c1 D + c2 D^2 + c3 D^3 + p1 (r - r0)^2 + p2 (c - c0)^2 + i1 A + i2 A^2."""
    d, p, i = (
        {symbol: one["value"] for symbol, one in groups[name].items()}
        for name in ("distance", "pixel", "intensity")
    )
    by_distance = d["c0"] + d["c1"] * distance + d["c2"] * distance**2 + d["c3"] * distance**3
    by_place = p["p1"] * (row - p["r0"]) ** 2 + p["p2"] * (column - p["c0"]) ** 2
    return by_distance + by_place + i["i1"] * amplitude + i["i2"] * amplitude**2


def distances_to_plane_mm(
    data: Dataset, frames: np.ndarray, tool_from_camera: Any, calibration: dict[str, Any] | None
) -> Tensor:
    """Return the distance of every usable pixel to its plane, without the package's model."""
    transform = torch.tensor(tool_from_camera, dtype=torch.float64)
    rays = data.ray_directions()
    found = []
    for batch in data.batches(frames):
        assert batch.amplitude is not None
        frame, row, column = batch.valid.nonzero(as_tuple=True)
        distance = batch.radial_distance[batch.valid]
        if calibration is not None:
            amplitude = batch.amplitude[batch.valid]
            groups = calibration["coefficients"]
            distance = distance - error_in_the_papers_symbols(
                groups, distance, amplitude, row.double(), column.double()
            )
        points = (rays[row, column] * distance[:, None]) @ transform[:3, :3].T + transform[:3, 3]
        found.append((points * batch.normal_tool[frame]).sum(-1) + batch.offset_tool[frame])
    return 1e3 * torch.cat(found)


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

    monkeypatch.setattr("tofcorr.training.figures_shown.drawn", fail)
    with pytest.raises(RuntimeError, match="no figures today"):
        tofcorr.train(trained.recording, CONFIG, out=tmp_path / "run")
    assert {path.name for path in (tmp_path / "run").iterdir()} == FILES
    assert json.loads((tmp_path / "run" / "report.json").read_text())["stopped"] == "converged"


def test_the_report_says_where_the_time_went(trained: Trained) -> None:
    seconds = trained.report()["seconds"]
    assert list(seconds) == ["read", "inspect", "fit", "report", "write", "figures"]
    assert all(value >= 0 for value in seconds.values())


def test_the_report_on_disk_is_that_of_the_result(trained: Trained) -> None:
    assert trained.report() == trained.result.report


def test_the_report_keeps_its_contract(trained: Trained) -> None:
    report = trained.report()
    assert (report["format"], report["version"]) == ("tofcorr-report", 1)
    assert (report["model"], report["stopped"]) == ("EA", "converged")
    assert report["iterations"] == trained.result.iterations[-1].number > 0
    assert list(report["error_mm"]) == ["before", "hand_eye_only", "after"]
    for halves in report["error_mm"].values():
        assert list(halves) == ["train", "test"]
        for errors in halves.values():
            assert set(errors) == {"mean_abs", "rms"}
            assert 0 < errors["mean_abs"] < errors["rms"]
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


@pytest.mark.parametrize("half", ["train", "test"])
def test_reported_errors_are_millimetres_to_the_plane(trained: Trained, half: str) -> None:
    report, calibration = trained.report(), trained.calibration()
    frames = np.array(report["frames"][half])
    recorded = np.asarray(trained.data.first.tool_from_camera)
    estimated = report["hand_eye"]["tool_from_camera"]
    for stage, transform, used in (
        ("before", recorded, None),
        ("after", estimated, calibration),
    ):
        off = distances_to_plane_mm(trained.data, frames, transform, used)
        told = report["error_mm"][stage][half]
        assert told["mean_abs"] == pytest.approx(float(off.abs().mean()), rel=1e-6)
        assert told["rms"] == pytest.approx(float(off.square().mean().sqrt()), rel=1e-6)


def test_the_hand_eye_is_known_to_its_standard_errors_in_their_units(trained: Trained) -> None:
    hand_eye = trained.report()["hand_eye"]
    found = np.array(hand_eye["tool_from_camera"])
    truth = true_hand_eye(trained.data).numpy()
    apart_mm = 1e3 * (found - truth)[:3, 3]
    turned = found[:3, :3] @ truth[:3, :3].T
    apart_deg = np.degrees([turned[2, 1], turned[0, 2], turned[1, 0]])
    # Six standard errors: with ten and more poses, a chance of one in ten thousand.
    assert (np.abs(apart_mm) < 6 * np.array(hand_eye["translation_se_mm"])).all()
    assert (np.abs(apart_deg) < 6 * np.array(hand_eye["rotation_se_deg"])).all()
    # In metres and radians they would be a thousand and 57 times too small.
    assert (np.array(hand_eye["translation_se_mm"]) > 1e-2).all()
    for name in ("translation", "rotation"):
        unit = "mm" if name == "translation" else "deg"
        half_widths = np.array(hand_eye[f"{name}_ci95_{unit}"])
        ratio = half_widths / np.array(hand_eye[f"{name}_se_{unit}"])
        assert ((ratio > 1.96) & (ratio < 3)).all()


def test_the_papers_coefficients_reproduce_the_correctors_error(trained: Trained) -> None:
    calibration = trained.calibration()
    assert calibration["sign"] == "error = measured - true; corrected = measured - error"
    corrector = torch.jit.load(trained.folder / "corrector.ts")
    low, high = calibration["validity"]["radial_distance_m"]
    dark, bright = calibration["validity"]["amplitude"]
    height, width = (calibration["camera"][name] for name in ("height", "width"))
    for share in (0.1, 0.5, 0.9):
        distance = low + share * (high - low)
        amplitude = bright - share * (bright - dark)
        depth = torch.full((height, width), distance, dtype=torch.float32)
        corrected, valid = corrector(depth, torch.full_like(depth, amplitude))
        for row, column in ((0, 0), (7, 20), (height - 1, width - 1)):
            expected = error_in_the_papers_symbols(
                calibration["coefficients"],
                *(torch.tensor(x, dtype=torch.float64) for x in (distance, amplitude)),
                *(torch.tensor(x, dtype=torch.float64) for x in (row, column)),
            )
            error = float(depth[row, column] - corrected[row, column])
            # float32 at one to three metres resolves 2.4e-7 m.
            assert error == pytest.approx(float(expected), abs=1e-6)
            assert bool(valid[row, column])


def test_every_coefficient_has_a_standard_error_and_the_ranges_are_those_of_the_fit(
    trained: Trained,
) -> None:
    calibration = trained.calibration()
    assert (calibration["format"], calibration["version"]) == ("tofcorr-calibration", 1)
    symbols = {name: set(group) for name, group in calibration["coefficients"].items()}
    assert symbols == {
        "distance": {"c0", "c1", "c2", "c3"},
        "pixel": {"p1", "r0", "p2", "c0"},
        "intensity": {"i1", "i2"},
    }
    for group in calibration["coefficients"].values():
        assert all(one["standard_error"] > 0 for one in group.values())
    domain = trained.result.fit.domain
    assert calibration["validity"]["radial_distance_m"] == list(domain.radial_distance)
    assert calibration["hand_eye"] == trained.report()["hand_eye"]
    assert calibration["held_out_error_mm"] == trained.report()["error_mm"]["after"]["test"]
    assert calibration["camera"]["K"] == [list(row) for row in trained.data.first.camera.matrix]
    assert calibration["noise"]["source"] == "neighbours"


def without_times(report: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in report.items() if key != "seconds"}


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


def test_the_command_prints_the_result(trained: Trained, tmp_path: Path) -> None:
    arguments = ["--config", trained.folder / "config.yaml", "--recording", trained.recording]
    told = CliRunner().invoke(command, [*map(str, arguments), "--out", str(tmp_path / "run")])
    assert told.exit_code == 0, told.output
    filed = f"{trained.result.report['message']} Run filed in {tmp_path / 'run'}\n"
    assert told.output == f"{trained.result!r}\n{filed}"


def test_the_text_holds_the_errors_and_the_hand_eye(trained: Trained) -> None:
    lines = repr(trained.result).splitlines()
    assert lines[0].split() == ["EA", "train", "held", "out"]
    for line, (stage, halves) in zip(lines[2:], trained.report()["error_mm"].items(), strict=False):
        numbers = [f"{halves[half][kind]:.2f}" for half in halves for kind in ("mean_abs", "rms")]
        assert line[:16].strip().replace("-", "_").replace(" ", "_") == stage
        assert line[16:].split() == numbers
    assert "hand-eye translation, mm" in lines[5]


def test_the_corrector_of_the_result_is_the_one_on_disk(trained: Trained) -> None:
    (batch,) = trained.data.batches(np.array([4]))
    assert batch.amplitude is not None
    depth, amplitude = batch.radial_distance.float(), batch.amplitude.float()
    expected, expected_valid = torch.jit.load(trained.folder / "corrector.ts")(depth, amplitude)
    found, valid = trained.result.corrector()(depth, amplitude)
    assert torch.equal(valid, expected_valid)
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-6, equal_nan=True)


def test_figures_are_returned_and_an_unknown_covariate_is_refused(trained: Trained) -> None:
    for name in ("distance", "amplitude", "row", "column", "angle of incidence"):
        assert isinstance(trained.result.plot_profile(name), Figure)
    assert len(trained.result.plot_residuals().axes) == 3 + 3
    assert len(trained.result.plot_points(2).axes) == 3
    with pytest.raises(CalibrationDataError, match=r"'heat'.*distance, row, column, amplitude"):
        trained.result.plot_profile("heat")


def press_ctrl_c_at(monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    """Send this process SIGINT when a watched solver has made so many iterations."""
    record = RunMonitor.iteration

    def press(monitor: RunMonitor, iteration: Iteration) -> None:
        record(monitor, iteration)
        if iteration.number == number:
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(RunMonitor, "iteration", press)


def test_ctrl_c_ends_early_and_resuming_ends_where_an_uninterrupted_run_does(
    trained: Trained, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    handler = signal.getsignal(signal.SIGINT)
    with monkeypatch.context() as patch:
        press_ctrl_c_at(patch, 1)
        cut = tofcorr.train(trained.recording, CONFIG, out=tmp_path / "cut")
    assert signal.getsignal(signal.SIGINT) is handler
    assert {path.name for path in (tmp_path / "cut").iterdir()} == FILES
    report = json.loads((tmp_path / "cut" / "report.json").read_text())
    assert (report["stopped"], report["iterations"]) == ("interrupted", 1)
    assert any("Interrupted after 1 iterations" in warning for warning in report["warnings"])

    resumed = tofcorr.train(trained.recording, CONFIG, resume=tmp_path / "cut")
    assert resumed.report["stopped"] == "converged"
    first = resumed.iterations[0].parameters
    stopped_at = cut.fit.solution.parameters
    assert torch.equal(first.tool_from_camera, stopped_at.tool_from_camera)
    assert torch.equal(first.coefficients, stopped_at.coefficients)

    whole = trained.result.fit
    assert in_standard_errors(trained, cut) > 1e-3
    # Either run ends within 1e-6 standard errors of the optimum, in the metric of the curvature.
    assert in_standard_errors(trained, resumed) < 1e-4
    assert resumed.fit.solution.loss == pytest.approx(whole.solution.loss, rel=1e-9)


def in_standard_errors(trained: Trained, other: TrainingResult) -> float:
    """Return the largest difference of any parameter from those of the uninterrupted run."""
    one, two = trained.result.fit.solution.parameters, other.fit.solution.parameters
    errors = trained.result.fit.covariance.standard_errors
    moved = (one.tool_from_camera - two.tool_from_camera)[:3, 3].norm() / errors[:3].min()
    changed = ((one.coefficients - two.coefficients).abs() / errors[6:]).max()
    return float(max(moved, changed))


def test_outside_the_main_thread_no_handler_is_set() -> None:
    seen: list[list[int]] = []

    def enter() -> None:
        with interruptible() as received:
            seen.append(list(received))

    thread = threading.Thread(target=enter)
    thread.start()
    thread.join()
    assert seen == [[]]


def test_a_run_of_another_model_is_not_resumed(trained: Trained) -> None:
    smaller = {**CONFIG, "model": {"terms": CONFIG["model"]["terms"][:1]}}
    with pytest.raises(ConfigError, match="other terms than the configuration"):
        tofcorr.train(trained.recording, smaller, resume=trained.folder)


def test_a_folder_without_a_run_is_not_resumed(trained: Trained, tmp_path: Path) -> None:
    with pytest.raises(CalibrationDataError, match=r"state\.pt: there is no such file"):
        tofcorr.train(trained.recording, CONFIG, resume=tmp_path)


def test_an_existing_folder_is_refused_before_the_fit_and_left_as_it_is(
    trained: Trained, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "mine.txt").write_text("keep")
    monkeypatch.setattr("tofcorr.training.run.calibrate", None)
    with pytest.raises(CalibrationDataError, match="exists already and is not overwritten"):
        tofcorr.train(trained.recording, CONFIG, out=tmp_path / "run")
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


def test_a_write_that_fails_leaves_no_folder(
    trained: Trained, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("tofcorr.training.folder.export_torchscript", full)
    with pytest.raises(OSError, match="No space left"):
        trained.result.save(tmp_path / "new" / "run")
    assert list(tmp_path.iterdir()) == []
