"""The whole diagnosis of one recording."""

from dataclasses import dataclass

import torch
from torch import Tensor

from tofcorr.data.recording import Recording
from tofcorr.diagnosis.findings.how_far import measure_gap
from tofcorr.diagnosis.findings.open_set import judge_remainder
from tofcorr.diagnosis.findings.select import least_p_value, select
from tofcorr.diagnosis.findings.where import find_where
from tofcorr.diagnosis.next.design import minimum_detectable, next_recording
from tofcorr.diagnosis.options import DiagnosisOptions
from tofcorr.diagnosis.report.result import Diagnosis
from tofcorr.diagnosis.report.verdict import write_verdict
from tofcorr.diagnosis.rerun.closure import close_the_loop
from tofcorr.diagnosis.rerun.transfer import measure_transfer
from tofcorr.diagnosis.rerun.twin import twin_distance
from tofcorr.diagnosis.sums.base_fit import fit_base
from tofcorr.diagnosis.sums.base_terms import BaseModel
from tofcorr.diagnosis.sums.observations import Observations, observe
from tofcorr.diagnosis.sums.prediction import effect_inputs, predicted_distance
from tofcorr.diagnosis.sums.study import Study, build_study
from tofcorr.error_terms.amplitude import AmplitudePolynomialOptions
from tofcorr.error_terms.model import ErrorModelOptions
from tofcorr.errors import ConfigError
from tofcorr.simulation.effects import CATALOGUE
from tofcorr.simulation.options import SimulatorOptions
from tofcorr.simulation.twin import default_hand_eye


@dataclass(frozen=True, kw_only=True)
class _Prepared:
    study: Study
    warnings: list[str]
    as_given: Tensor | None


def diagnose(
    recording: Recording, options: DiagnosisOptions, simulator: SimulatorOptions | None = None
) -> Diagnosis:
    """Find out where a simulator and a recording part, and why.

    Args:
        recording: The real recording.
        options: Of the diagnosis.
        simulator: What is under diagnosis; None: a simulator fitted to the recording.

    Raises:
        ConfigError: An effect is unknown.
        CalibrationDataError: The recording cannot support a diagnosis.
    """
    prepared = prepare(recording, options, simulator)
    study = prepared.study
    selection = select(study)
    generator = torch.Generator().manual_seed(options.seed + 1)
    gap = measure_gap(study, selection, generator, prepared.as_given)
    closure = transfer = None
    if options.simulate_anew:
        closure = close_the_loop(study, selection, simulator)
        transfer = measure_transfer(study, selection, simulator, generator)
    remains = judge_remainder(study, selection, gap)
    detectable = minimum_detectable(study, selection, options.seed + 2)
    missing = dict(study.missing)
    return Diagnosis(
        study=study,
        selection=selection,
        gap=gap,
        where=find_where(study),
        detected=selection.tested and (bool(selection.named) or remains.unknown),
        p_value=least_p_value(study, selection.first),
        unknown=remains.unknown,
        detectable=detectable,
        advice=next_recording(study, selection),
        verdict=write_verdict(
            selection,
            gap,
            unknown=remains.unknown,
            fingerprint=remains.fingerprint,
            detectable=detectable,
            missing=missing,
        ),
        closure=closure,
        transfer=transfer,
        warnings=prepared.warnings,
        extra={
            "unknown_score": round(remains.score, 4),
            "remaining_share": round(remains.remaining_share, 4),
            "fingerprint": list(remains.fingerprint),
            "taken_up": list(selection.taken_up),
        },
    )


def prepare(
    recording: Recording, options: DiagnosisOptions, simulator: SimulatorOptions | None
) -> _Prepared:
    """Read the recording, fit the base model and sum everything up."""
    _check_names(options)
    observations = observe(recording, options.most_pixels)
    base, warnings = _base_for(observations, options.base)
    model = BaseModel(observations, base, hand_eye_free=_hand_eye_free(recording, options))
    as_given = None
    known = None
    if simulator is not None:
        known, as_given = _known_error(observations, simulator)
    fit = fit_base(model, observations, known)
    generator = torch.Generator().manual_seed(options.seed)
    inputs = effect_inputs(observations, fit.tool_from_camera)
    study = build_study(options, observations, fit, inputs, generator)
    return _Prepared(study=study, warnings=warnings, as_given=as_given)


def _known_error(observations: Observations, simulator: SimulatorOptions) -> tuple[Tensor, Tensor]:
    """Return the error that the simulator has already, and the residual to it as given, (M,)."""
    pose = default_hand_eye(simulator, observations.recording)
    twin = twin_distance(observations, simulator, pose)
    error = (twin - predicted_distance(observations, pose)).nan_to_num(0.0)
    return error, (observations.measured - twin).nan_to_num(0.0)


def _hand_eye_free(recording: Recording, options: DiagnosisOptions) -> bool:
    if options.hand_eye == "auto":
        return recording.moves
    return options.hand_eye == "estimate"


def _base_for(
    observations: Observations, base: ErrorModelOptions
) -> tuple[ErrorModelOptions, list[str]]:
    """Leave out amplitude terms where no amplitude was recorded."""
    if observations.amplitude is not None:
        return base, []
    kept = tuple(t for t in base.terms if not isinstance(t, AmplitudePolynomialOptions))
    if len(kept) == len(base.terms):
        return base, []
    warning = (
        f"{observations.recording.path}: amplitude.npy is missing; "
        "the base model has no amplitude term."
    )
    return ErrorModelOptions(terms=kept), [warning]


def _check_names(options: DiagnosisOptions) -> None:
    for name in (*(options.catalogue or ()), *options.leave_out):
        if name not in CATALOGUE:
            known = ", ".join(sorted(CATALOGUE))
            raise ConfigError(f"There is no effect '{name}' to consider. Known: {known}.")
