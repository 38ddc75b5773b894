"""The run folder: everything that later commands read, and where an interrupted run stood."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from tofcorr.correction.corrector import DepthCorrector
from tofcorr.correction.export.torchscript import export_torchscript
from tofcorr.correction.state import (
    STATE_FILE,
    CalibrationState,
    ResidualState,
    load_calibration,
    save_calibration,
)
from tofcorr.errors import CalibrationDataError, ConfigError
from tofcorr.estimation.parameters import Parameters
from tofcorr.files.staged import staged_file
from tofcorr.fit.core import same_terms
from tofcorr.fit.reference.estimate import estimate_reference
from tofcorr.fit.reference.reference import Reference
from tofcorr.fit.reference.reference_file import REFERENCE_FILE, save_reference
from tofcorr.fit.result import Fit
from tofcorr.options import dump_yaml
from tofcorr.pixels.dataset import Dataset
from tofcorr.training.calibration import Calibration
from tofcorr.training.calibration_file import calibration_mapping
from tofcorr.training.hand_eye import hand_eye_accuracy
from tofcorr.training.options import TrainingOptions


def write_run(
    folder: Path,
    calibration: Calibration,
    options: TrainingOptions,
    report: Mapping[str, Any],
    *,
    corrector: bool = True,
) -> None:
    """Write all files of a run into an existing folder, except TensorBoard's.

    Args:
        folder: Where the files go.
        calibration: The fitted model.
        options: Those of the training.
        report: The content of report.json.
        corrector: Whether to write corrector.ts.
    """
    data, fit = calibration.data, calibration.fit
    state = calibration_state(data, options, fit)
    save_calibration(folder / STATE_FILE, state)
    reference = run_reference(calibration, state)
    if reference is not None:
        save_reference(folder / REFERENCE_FILE, reference, state)
    if corrector:
        export_torchscript(DepthCorrector.from_state(state), folder / "corrector.ts", state)
    write_report(folder, report)
    text = dump_yaml(options.to_mapping(), last="model")
    (folder / "config.yaml").write_text(text, encoding="utf-8")
    values = calibration_mapping(data, options, fit, report, fit.noise)
    (folder / "calibration.yaml").write_text(dump_yaml(values), encoding="utf-8")


def run_reference(calibration: Calibration, state: CalibrationState) -> Reference | None:
    """Return what a later check must know of the frames, fitted and held out; None: unknown."""
    fit = calibration.fit
    return estimate_reference(
        calibration.data,
        np.sort(np.concatenate([calibration.train, calibration.test])),
        fit.model,
        fit.domain,
        state.noise,
        twist=state.hand_eye_estimated,
        walls_are_known=fit.walls is None,
    )


def write_report(folder: Path, report: Mapping[str, Any]) -> None:
    """Write report.json, whole or not at all; an older one is replaced."""
    text = json.dumps(dict(report), indent=1, allow_nan=False) + "\n"
    with staged_file(folder / "report.json") as part:
        part.write_text(text, encoding="utf-8")


def calibration_state(data: Dataset, options: TrainingOptions, fit: Fit) -> CalibrationState:
    """Return the calibration as the numbers that a corrector is built from."""
    recording, error, parameters = data.first, fit.model.error, fit.solution.parameters
    return CalibrationState(
        name=options.name,
        error_model=fit.options,
        domain=fit.domain,
        coefficients=parameters.coefficients,
        tool_from_camera=parameters.tool_from_camera,
        hand_eye_estimated=parameters.hand_eye_is_free,
        camera=recording.camera,
        depth_kind=recording.depth_kind,
        saturation_amplitude=recording.saturation_amplitude,
        fixed_pattern=error.fixed_pattern.offset if error.fixed_pattern is not None else None,
        residual=_residual_state(options, fit),
        covariance=_coefficient_covariance(fit),
        noise=None if fit.noise is None else fit.noise.coefficients,
        frames=recording.frame_names,
        hand_eye_accuracy=hand_eye_accuracy(fit),
    )


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
        raise ConfigError(
            f"{run}: its model has other terms than the configuration asks for; resume with the "
            "configuration of that run, its config.yaml."
        )
    return Parameters(state.tool_from_camera, state.coefficients, state.hand_eye_estimated)


def _coefficient_covariance(fit: Fit) -> Tensor:
    first = fit.solution.parameters.twist_size
    return fit.covariance.matrix[first:, first:]


def _residual_state(options: TrainingOptions, fit: Fit) -> ResidualState | None:
    network = fit.model.error.residual
    if network is None or options.residual is None:
        return None
    return ResidualState(options=options.residual.network, weights=network.weight_vector())
