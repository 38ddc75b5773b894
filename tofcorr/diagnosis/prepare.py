"""Reads a recording, fits the base model, and computes the sums that the diagnosis needs."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from tofcorr.data.recording import Recording
from tofcorr.diagnosis.findings.absorbed_by_planes import without_absorbed
from tofcorr.diagnosis.findings.coherence import coherence
from tofcorr.diagnosis.options import DiagnosisOptions
from tofcorr.diagnosis.rerun.twin import twin_distance
from tofcorr.diagnosis.sums.base_fit import fit_base
from tofcorr.diagnosis.sums.base_model import BaseModel
from tofcorr.diagnosis.sums.base_options import definite_base, map_term
from tofcorr.diagnosis.sums.changes import without_map
from tofcorr.diagnosis.sums.estimated_planes import with_numbered_walls
from tofcorr.diagnosis.sums.map_gain import map_gain, whole_map
from tofcorr.diagnosis.sums.observations import Observations, observe
from tofcorr.diagnosis.sums.prediction import effect_inputs, predicted_distance
from tofcorr.diagnosis.sums.study import Study, build_study, residual_of
from tofcorr.errors import ConfigError
from tofcorr.simulation.effects import CATALOGUE, MapEffect
from tofcorr.simulation.options import SimulatorOptions
from tofcorr.simulation.twin import default_hand_eye

# Least prior standard deviation of a fixed pattern, metres, so that its inverse is finite.
_LEAST_SPREAD = 1e-6


@dataclass(frozen=True, kw_only=True)
class Prepared:
    """A recording ready for diagnosis.

    Attributes:
        study: Pixels, base fit, candidate effects and sums.
        warnings: What was unexpected, a sentence each.
        as_given: Residual of the simulator as given, shape (M,), metres; None without one.
    """

    study: Study
    warnings: tuple[str, ...]
    as_given: Tensor | None


def prepare(
    recording: Recording, options: DiagnosisOptions, simulator: SimulatorOptions | None = None
) -> Prepared:
    """Read the recording, fit the base model and compute all sums.

    Args:
        recording: The real recording.
        options: Of the diagnosis.
        simulator: The simulator under diagnosis; None: one is fitted to the recording.

    Raises:
        ConfigError: An effect is unknown.
        CalibrationDataError: The recording lacks what a base term needs, has too few frames, or its
            planes are estimated and cannot be estimated anew.
    """
    _check_names(options)
    base, warnings = definite_base(recording, options.base)
    observations = with_numbered_walls(observe(recording, options.most_pixels))
    model = BaseModel(observations, base, hand_eye_free=_hand_eye_free(recording, options))
    known = as_given = None
    if simulator is not None:
        known, as_given = _known_error(observations, simulator)
    fit = fit_base(model, observations, known)
    observations = fit.model.observations
    generator = torch.Generator().manual_seed(options.seed)
    inputs = effect_inputs(observations, fit.tool_from_camera)
    study = build_study(options, observations, fit, inputs, generator)
    study, absorbed = without_absorbed(study)
    study = _with_base_pattern(study)
    return Prepared(study=study, warnings=(*warnings, *absorbed), as_given=as_given)


def _known_error(observations: Observations, simulator: SimulatorOptions) -> tuple[Tensor, Tensor]:
    """Return the error that the simulator makes, and the residual to it as given, (M,), metres."""
    pose = default_hand_eye(simulator, observations.recording)
    twin = twin_distance(observations, simulator, pose)
    error = (twin - predicted_distance(observations, pose)).nan_to_num(0.0)
    return error, (observations.measured - twin).nan_to_num(0.0)


def _with_base_pattern(study: Study) -> Study:
    """Subtract the fixed pattern of the base model, if it has one.

    Each pixel's value is estimated from the poses of other folds, as with a map that is named. The
    spread `auto` is what the residual has in common in all images.
    """
    term = map_term(study.fit.model.options)
    if term is None:
        return study
    kind = CATALOGUE[term.kind]
    pattern = kind.for_recording(study.inputs)
    assert isinstance(pattern, MapEffect)
    residual = residual_of(study, ())
    if term.spread_mm == "auto":
        spread = max(coherence(study, residual).fixed, 0.0) ** 0.5
    else:
        spread = term.spread_mm * 1e-3
    spread = max(spread, _LEAST_SPREAD)
    values = map_gain(study, pattern, residual, prior_sd=spread).values
    whole = whole_map(study, pattern, residual, prior_sd=spread)
    study = without_map(study, values, {kind.name, *kind.contains})
    return replace(study, pattern=pattern.with_coefficients(whole))


def _hand_eye_free(recording: Recording, options: DiagnosisOptions) -> bool:
    if options.hand_eye == "auto":
        return recording.moves
    return options.hand_eye == "estimate"


def _check_names(options: DiagnosisOptions) -> None:
    for name in (*(options.catalogue or ()), *options.leave_out):
        if name not in CATALOGUE:
            known = ", ".join(sorted(CATALOGUE))
            raise ConfigError(f"There is no effect '{name}' to consider. Known: {known}.")
