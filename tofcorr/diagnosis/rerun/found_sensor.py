"""The camera as a diagnosis found it: the content of `sensor.yaml`."""

import copy
from collections.abc import Mapping, Sequence
from typing import Any, cast

import torch
from torch import Tensor

from tofcorr.data.header import RigidTransform
from tofcorr.diagnosis.findings.naming import NamedEffects
from tofcorr.diagnosis.rerun.fitted_simulator import (
    NO_PATTERNS,
    Patterns,
    fitted_effects,
    solution_of,
)
from tofcorr.diagnosis.sums.observations import predicted_distance
from tofcorr.diagnosis.sums.study import Study
from tofcorr.observables import Observables, compare_observables
from tofcorr.sensor.parts import section_of
from tofcorr.sensor.sensor_file import (
    ErrorSection,
    SensorCamera,
    SensorFile,
    dropout_section,
    light_section,
    validity_of,
)
from tofcorr.simulation.effects import CatalogueEffect, MapEffect
from tofcorr.simulation.effects.registry import build_effects
from tofcorr.simulation.options import SimulatorOptions

# Remainder of a simulator's own error that is stated, metres, root mean square: a tenth of the
# least gap that matters. Chosen.
_STATED = 1e-4


def sensor_of(
    study: Study,
    named: NamedEffects,
    simulator: SimulatorOptions | None,
    observables: Observables | None,
    patterns: Patterns = NO_PATTERNS,
) -> SensorFile:
    """Return the sensor that a diagnosis found: base terms, named effects, noise, missing pixels.

    Args:
        study: The recording, before any effect was named.
        named: The effects named.
        simulator: The built-in simulator under diagnosis, with the named effects added; None where
            another simulator rendered frames.
        observables: Noise and missing pixels of the recording; None: the sensor has neither.
        patterns: As in `fitted_effects`.
    """
    recording = study.observations.recording
    own: list[CatalogueEffect] = [] if study.pattern is None else [study.pattern]
    own += fitted_effects(study, named, patterns)
    entries = [effect.in_other_recordings().to_mapping() for effect in own]
    given = [] if simulator is None else list(simulator.effects)[: -len(own) or None]
    error, remainder = given_error(study, given)
    pose, fitted = solution_of(study, named)
    sentences = [
        f"{study.observations.num_units} poses, {recording.num_frames} frames.",
        *([] if named.names else ["No effect beyond the error terms was found."]),
    ]
    if remainder > _STATED:
        sentences.append(
            f"The simulator under diagnosis makes an error of {1e3 * remainder:.1f} mm RMS that no "
            "term or effect of this file holds."
        )
    return SensorFile(
        format="tofcorr-sensor",
        version=1,
        title="A time-of-flight camera, as a diagnosis found it.",
        measured_from=tuple(sentences),
        camera=SensorCamera.of(recording.camera),
        depth_kind=recording.depth_kind,
        modulation_frequency_hz=recording.modulation_frequency,
        tool_from_camera=cast(RigidTransform, tuple(map(tuple, pose.tolist()))),
        error=_error_section(study, fitted + error),
        effects=(*given, *entries),
        **({} if observables is None else _sections(study, observables, own)),
        validity=validity_of(study.fit.model.domain),
    )


def _error_section(study: Study, coefficients: Tensor) -> ErrorSection:
    model = study.fit.model
    error = copy.deepcopy(model.error_model)
    error.set_coefficient_vector(coefficients)
    terms = model.options.with_columns().terms
    return section_of(error, ErrorSection(reads="true_distance", terms=terms))


def given_error(study: Study, effects: Sequence[Mapping[str, Any]]) -> tuple[Tensor, float]:
    """Return a given simulator's own error as coefficients of the base terms, and what is left.

    Without a given simulator both are zero.

    Returns:
        Shape (K,), metres; root mean square of the rest, metres.
    """
    fit, observations = study.fit, study.observations
    if fit.known is None:
        return torch.zeros_like(fit.coefficients), 0.0
    distance = predicted_distance(observations, fit.tool_from_camera)
    columns = fit.model.error_columns(distance)
    known = observations.measured - fit.residual - distance - columns @ fit.coefficients
    for effect in build_effects(effects):
        assert isinstance(effect, CatalogueEffect)
        known = known - effect.shift(study.inputs, effect.coefficients)
    root = fit.share.sqrt()[:, None]
    solved = torch.linalg.lstsq(root * columns, root * known[:, None], driver="gelsd").solution
    rest = known - columns @ solved[:, 0]
    return solved[:, 0], float(((fit.share * rest**2).sum() / fit.share.sum()).sqrt())


def _sections(
    study: Study, observables: Observables, own: Sequence[CatalogueEffect]
) -> dict[str, Any]:
    """Return the sections of noise, missing pixels and light."""
    pattern = any(isinstance(effect, MapEffect) for effect in own)
    recording = study.observations.recording
    if observables.seen.recording is not recording:  # Its planes were estimated with the rest.
        observables = compare_observables(recording, None, seed=study.options.seed)
    curve = observables.real_noise.curve
    return {
        # The fixed part may stand among the effects, pixel by pixel.
        "noise": curve.with_fixed_share(0.0) if pattern else curve,
        "dropouts": dropout_section(observables.real_dropouts.model, observables.seen),
        "light": light_section(observables.seen),
    }
