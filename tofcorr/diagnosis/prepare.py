"""Reads a recording, fits the base model, and computes the sums that the diagnosis needs."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from tofcorr.data.recording import Recording
from tofcorr.diagnosis.findings.outliers import Outliers, mask_warning, outliers_of
from tofcorr.diagnosis.given import GivenSimulator
from tofcorr.diagnosis.options import DiagnosisOptions
from tofcorr.diagnosis.sums.base import (
    BaseModel,
    SimulatorError,
    definite_base,
    filtered_inputs,
    fit_base,
)
from tofcorr.diagnosis.sums.maps import FittedMap
from tofcorr.diagnosis.sums.observations import (
    Observations,
    effect_inputs,
    observe,
    with_numbered_walls,
)
from tofcorr.diagnosis.sums.study import Study, build_study, without_absorbed, without_map
from tofcorr.error_terms.pixel_terms import FixedPatternOptions
from tofcorr.errors import CalibrationDataError, ConfigError
from tofcorr.simulation.effects import CATALOGUE, MapEffect


@dataclass(frozen=True, kw_only=True)
class Prepared:
    """A recording ready for diagnosis.

    Attributes:
        study: Pixels, base fit, candidate effects and sums.
        warnings: What was unexpected, a sentence each.
        as_given: Residual of the simulator as given, shape (M,), metres; None without one.
        outliers: Pixels that the fit does not fully use.
    """

    study: Study
    warnings: tuple[str, ...]
    as_given: Tensor | None
    outliers: Outliers


def prepare(
    recording: Recording, options: DiagnosisOptions, simulator: GivenSimulator | None = None
) -> Prepared:
    """Read the recording, fit the base model and compute all sums.

    Args:
        recording: The real recording.
        options: Of the diagnosis.
        simulator: The simulator under diagnosis; None: one is fitted to the recording.

    Raises:
        ConfigError: An effect is unknown.
        CalibrationDataError: The recording lacks what a base term needs, has too few frames, or its
            planes are estimated and cannot be estimated anew; or the simulator's frames cannot be
            compared with it.
    """
    for name in (*(options.catalogue or ()), *options.leave_out):
        if name not in CATALOGUE:
            known = ", ".join(sorted(CATALOGUE))
            raise ConfigError(f"There is no effect '{name}' to consider. Known: {known}.")
    camera = recording.camera
    if min(camera.width, camera.height) < 2:
        raise CalibrationDataError(
            f"{recording.path}: a diagnosis compares neighbouring pixels, and images of "
            f"{camera.width}x{camera.height} pixels have none; 2x2 at least are needed."
        )
    base, warnings = definite_base(recording, options.base)
    observations = with_numbered_walls(observe(recording, options.most_pixels))
    known = None
    if simulator is not None:
        observations, known, limits = _both_known(observations, simulator, options)
        warnings = [*warnings, *limits]
    free = recording.moves if options.hand_eye == "auto" else options.hand_eye == "estimate"
    model = BaseModel(observations, base, hand_eye_free=free)
    fit = fit_base(model, observations, known)
    observations = fit.model.observations
    as_given = None if known is None else known.residual(observations)
    generator = torch.Generator().manual_seed(options.seed)
    inputs = effect_inputs(observations, fit.tool_from_camera)
    inputs = filtered_inputs(inputs, observations, fit)
    study = build_study(options, observations, fit, inputs, generator)
    study, absorbed = without_absorbed(study)
    study = _with_base_pattern(study)
    outliers = outliers_of(study)
    warnings += filter(None, (outliers.warning, mask_warning(observations)))
    return Prepared(
        study=study, warnings=(*warnings, *absorbed), as_given=as_given, outliers=outliers
    )


def _both_known(
    observations: Observations, simulator: GivenSimulator, options: DiagnosisOptions
) -> tuple[Observations, SimulatorError, list[str]]:
    """Return the pixels for which a simulator has a distance, its error there, and warnings.

    With fewer than a tenth of the pixels the comparison would be about another recording; a
    thousandth without a distance is worth a warning.
    """
    error = simulator.simulate(observations, options)
    limits = list(error.limits)
    known = error.error.isfinite()
    share = float(known.double().mean())
    frames = len(torch.unique(observations.frame[known]))
    if 10 * share < 1 or frames < 2:
        raise CalibrationDataError(
            f"{observations.recording.path}: the simulator has a distance for {100 * share:.1f} % "
            f"of the recording's pixels, in {frames} frames; simulate its poses and targets, or "
            "a range of distances and amplitudes that covers it."
        )
    if 1000 * (1 - share) >= 1:
        limits.append(
            f"The simulator has no distance for {100 * (1 - share):.1f} % of the recording's "
            "pixels; they are left out."
        )
    return observations.at(known), error.at(known), limits


def _with_base_pattern(study: Study) -> Study:
    """Subtract the fixed pattern of the base model, if it has one.

    Each pixel's value is estimated from the poses of other folds, as with a map that is named. The
    spread `auto` is what the residual has in common in all images.
    """
    terms = study.fit.model.options.terms
    term = next((term for term in terms if isinstance(term, FixedPatternOptions)), None)
    if term is None:
        return study
    kind = CATALOGUE[term.kind]
    pattern = kind.for_recording(study.inputs)
    assert isinstance(pattern, MapEffect)
    residual = study.system.residual_of(())
    spread = None if term.spread_mm == "auto" else term.spread_mm / 1000
    # A micrometre at least, so that the inverse of the spread is finite.
    fitted = FittedMap(study, pattern, residual, prior_sd=spread, least_sd=1e-6)
    study = without_map(study, fitted.values, {kind.name, *kind.contains})
    return replace(study, pattern=pattern.with_coefficients(fitted.whole()))
