"""One training: from a data set to the run folder that everything later reads."""

import json
import signal
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import torch

from tofcorr.correction.corrector import DepthCorrector
from tofcorr.correction.export.torchscript import export_torchscript
from tofcorr.correction.hand_eye import HandEye
from tofcorr.correction.model import CalibrationModel
from tofcorr.correction.state import (
    STATE_FILE,
    CalibrationState,
    ResidualState,
    load_calibration,
    save_calibration,
)
from tofcorr.data.staging import StagedFolder
from tofcorr.error_terms.domain import Domain
from tofcorr.error_terms.model import ErrorModel, ErrorModelOptions
from tofcorr.errors import CalibrationDataError, ConfigError
from tofcorr.estimation.noise import DistanceNoise
from tofcorr.estimation.parameters import Parameters
from tofcorr.estimation.solution import Iteration, Watcher
from tofcorr.fit.core import same_terms
from tofcorr.fit.fitting import Fit, fit
from tofcorr.fit.unknown_walls import wall_summary
from tofcorr.options import dump_yaml
from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.distributed import alone, is_first, process_group
from tofcorr.pixels.domain import covered_domain
from tofcorr.pixels.hand_eye import recorded_hand_eye
from tofcorr.pixels.masks import usable_pixels
from tofcorr.pixels.metrics import FrameErrors, frame_errors
from tofcorr.pixels.noise_sample import estimate_noise
from tofcorr.pixels.split import split_frames
from tofcorr.training import report as reporting
from tofcorr.training.monitor import RunMonitor
from tofcorr.training.next_poses import advise, draw_pool
from tofcorr.training.options import TrainingOptions
from tofcorr.training.support import recording_support
from tofcorr.training.uncertainty import bootstrap_summary, interval_summary
from tofcorr.version import __version__


def train(
    dataset: Dataset,
    options: TrainingOptions,
    out: Path | str,
    resumed: Parameters | None = None,
) -> dict[str, Any]:
    """Calibrate a data set and file the run, whole or not at all.

    Args:
        dataset: The recordings.
        options: Model, split and solver.
        out: Folder of the run; nothing may be there yet.
        resumed: Where an interrupted run stood.

    Returns:
        The report, as in `report.json`.

    Raises:
        CalibrationDataError: The data cannot support the model, or `out` exists.
    """
    dataset = usable_pixels(dataset, options, robust=options.weights.robust != "none")
    with process_group(options.device) as device, _interruptible() as interrupted:
        # Every process fits, so that none waits; the first one alone watches and writes.
        stage = StagedFolder(out) if is_first() else None
        with stage or nullcontext():
            monitor = RunMonitor(stage.folder / "tb") if stage else None

            def watch(iteration: Iteration) -> bool:
                if monitor:
                    monitor.iteration(iteration)
                return not interrupted

            local = options.model_copy(update={"device": device})
            done = _calibrate(dataset, local, watch, resumed)
            report = _report(done.dataset, options, done)
            if stage and monitor:
                with alone():
                    _file(stage.folder, done.dataset, options, done.fit, report)
                    monitor.finish(
                        done.dataset, done.fit, done.stages, done.train, done.test, report
                    )
                    monitor.close()
    return report


@dataclass(frozen=True)
class _Calibrated:
    """A fit and how it measures up; the data set has the walls that the fit believes in."""

    dataset: Dataset
    fit: Fit
    stages: dict[str, CalibrationModel]
    errors: dict[str, Any]
    measured: FrameErrors
    train: np.ndarray
    test: np.ndarray


def _calibrate(
    dataset: Dataset, options: TrainingOptions, watcher: Watcher, resumed: Parameters | None
) -> _Calibrated:
    """Split, fit and measure."""
    training, test = split_frames(dataset, options.split)
    domain = covered_domain(dataset, training)
    result = fit(dataset, training, options, domain, watcher, resumed)
    if result.walls is not None:
        dataset = result.walls.put_into(dataset)
    stages = models_by_stage(dataset, result)
    measured = frame_errors(dataset, stages, device=options.device)
    errors = reporting.error_summary(measured, training, test)
    return _Calibrated(dataset, result, stages, errors, measured["after"], training, test)


def _report(dataset: Dataset, options: TrainingOptions, done: _Calibrated) -> dict[str, Any]:
    solution = done.fit.solution
    support = recording_support(dataset, done.train, solution.parameters.tool_from_camera)
    return {
        "format": "tofcorr-report",
        "version": 1,
        "tofcorr": __version__,
        "model": options.name,
        "stopped": solution.stopped,
        "message": solution.message,
        "iterations": solution.iterations,
        "hand_eye": reporting.hand_eye_summary(done.fit) | interval_summary(done.fit),
        "error_mm": done.errors,
        "frames": {"train": done.train.tolist(), "test": done.test.tolist()},
        "weights": reporting.weight_summary(done.fit),
        "walls": None
        if done.fit.walls is None
        else wall_summary(done.fit.walls.names, done.fit.walls.walls),
        "outlying_images": reporting.outlier_summary(done.measured),
        "bootstrap": bootstrap_summary(done.fit, _generator(options)),
        "observability": reporting.observability_summary(done.fit, support),
        "advice": _advice(dataset, options, done),
        "warnings": reporting.warnings(done.fit, dataset, done.errors, support),
    }


def _generator(options: TrainingOptions) -> torch.Generator:
    return torch.Generator().manual_seed(options.split.seed)


def _advice(dataset: Dataset, options: TrainingOptions, done: _Calibrated) -> dict[str, Any] | None:
    """Return which poses to add; None if nobody asked, or if none was found."""
    if not options.advice:
        return None
    generator = np.random.default_rng(options.split.seed)
    pool = draw_pool(dataset, done.train, done.fit, generator)
    return None if pool is None else advise(dataset, pool, done.fit, options.advice)[1]


def models_by_stage(dataset: Dataset, result: Fit) -> dict[str, CalibrationModel]:
    """Return the models whose errors stand side by side: before, hand-eye only, after."""
    return {
        "before": _without_correction(result.domain, recorded_hand_eye(dataset)),
        "hand_eye_only": _without_correction(result.domain, result.hand_eye_only.tool_from_camera),
        "after": result.model,
    }


def resumed_parameters(run: Path | str, options: TrainingOptions) -> Parameters:
    """Return where the run in a folder stood.

    Raises:
        CalibrationDataError: The folder holds no run.
        ConfigError: The run was of another model.
    """
    path = Path(run) / STATE_FILE
    if not path.is_file():
        raise CalibrationDataError(f"{path}: there is no such file; is {run} a run of tofcorr?")
    state = load_calibration(path)
    if not same_terms(state.error_model, options.model):
        raise ConfigError(f"{run}: was trained with another model than the configuration asks for.")
    return Parameters(state.tool_from_camera, state.coefficients, state.hand_eye_estimated)


def _without_correction(domain: Domain, tool_from_camera: torch.Tensor) -> CalibrationModel:
    hand_eye = HandEye(fixed=True)
    hand_eye.rebase(tool_from_camera)
    return CalibrationModel(ErrorModel(ErrorModelOptions(), domain), hand_eye)


def _file(
    folder: Path, dataset: Dataset, options: TrainingOptions, result: Fit, report: dict[str, Any]
) -> None:
    """Write everything but TensorBoard's own files."""
    camera, error = dataset.first, result.model.error
    noise = _noise(dataset, np.array(report["frames"]["train"]), result)
    state = CalibrationState(
        name=options.name,
        error_model=result.options,
        domain=result.domain,
        coefficients=result.solution.parameters.coefficients,
        tool_from_camera=result.solution.parameters.tool_from_camera,
        hand_eye_estimated=result.solution.parameters.hand_eye_is_free,
        camera=camera.camera,
        depth_kind=camera.depth_kind,
        saturation_amplitude=camera.saturation_amplitude,
        fixed_pattern=error.fixed_pattern.offset if error.fixed_pattern is not None else None,
        residual=_residual_state(options, result),
        covariance=_coefficient_covariance(result),
        noise=None if noise is None else (noise.floor, noise.shot, noise.readout),
    )
    save_calibration(folder / STATE_FILE, state)
    export_torchscript(DepthCorrector.from_state(state), folder / "corrector.ts", state)
    _write_json(folder / "report.json", report)
    (folder / "config.yaml").write_text(dump_yaml(options.to_mapping()), encoding="utf-8")
    calibration = reporting.calibration_mapping(dataset, options, result, report)
    calibration["noise"] = None if noise is None else noise.to_mapping()
    (folder / "calibration.yaml").write_text(dump_yaml(calibration), encoding="utf-8")


def _coefficient_covariance(result: Fit) -> torch.Tensor:
    first = result.solution.parameters.twist_size
    return result.covariance.matrix[first:, first:]


def _noise(dataset: Dataset, frames: np.ndarray, result: Fit) -> DistanceNoise | None:
    """Return how a distance scatters; None where the recording does not tell."""
    if result.weights is not None and result.weights.noise is not None:
        return result.weights.noise
    if not dataset.has_amplitude:
        return None
    try:
        return estimate_noise(dataset, frames)
    except CalibrationDataError:
        return None


def _residual_state(options: TrainingOptions, result: Fit) -> ResidualState | None:
    network = result.model.error.residual
    if network is None or options.residual is None:
        return None
    return ResidualState(options=options.residual.network, weights=network.weight_vector())


def _write_json(path: Path, values: dict[str, Any]) -> None:
    path.write_text(json.dumps(values, indent=1, allow_nan=False) + "\n", encoding="utf-8")


@contextmanager
def _interruptible() -> Iterator[list[int]]:
    """Collect Ctrl-C instead of raising it: the list is empty until it is pressed."""
    pressed: list[int] = []

    def note(number: int, _: FrameType | None) -> None:
        pressed.append(number)

    try:
        before = signal.signal(signal.SIGINT, note)
    except ValueError:  # Not in the main thread: interruptions reach the caller as usual.
        yield pressed
        return
    try:
        yield pressed
    finally:
        signal.signal(signal.SIGINT, before)
