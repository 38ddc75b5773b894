"""A training goes on where it was interrupted, as if nothing had happened."""

import json
import signal
import threading
from pathlib import Path

import pytest
import torch
from training.trained import CONFIG, FILES, Trained

import tofcorr
from tofcorr import CalibrationDataError, ConfigError, TrainingResult
from tofcorr.estimation.solvers import Solution
from tofcorr.training.monitor import RunMonitor
from tofcorr.training.run import interruptible


def press_ctrl_c_at(monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    """Send this process SIGINT when a watched solver has made so many iterations."""
    record = RunMonitor.iteration

    def press(monitor: RunMonitor, iteration: Solution) -> None:
        record(monitor, iteration)
        if iteration.iterations == number:
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
    errors = trained.result.fit.covariance.matrix.diagonal().sqrt()
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


def test_a_run_of_another_model_and_a_folder_without_one_are_not_resumed(
    trained: Trained, tmp_path: Path
) -> None:
    smaller = {**CONFIG, "model": {"terms": CONFIG["model"]["terms"][:1]}}
    with pytest.raises(ConfigError, match="other terms; resume with its own"):
        tofcorr.train(trained.recording, smaller, resume=trained.folder)
    with pytest.raises(CalibrationDataError, match=r"state\.pt: there is no such file"):
        tofcorr.train(trained.recording, CONFIG, resume=tmp_path)
