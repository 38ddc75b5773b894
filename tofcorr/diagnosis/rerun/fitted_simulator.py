"""A simulator that behaves as a fit describes: its options can be written out and run."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
from torch import Tensor

from tofcorr.data.recording import Recording
from tofcorr.diagnosis.findings.absorption import fitted_coefficients
from tofcorr.diagnosis.findings.naming import NamedEffects
from tofcorr.diagnosis.rerun.error_tables import ErrorTables, error_tables
from tofcorr.diagnosis.sums.base_fit import BaseFit
from tofcorr.diagnosis.sums.map_gain import whole_map
from tofcorr.diagnosis.sums.observations import Observations
from tofcorr.diagnosis.sums.study import Study
from tofcorr.geometry import se3
from tofcorr.geometry.ranges import unambiguous_range
from tofcorr.simulation.effects import CatalogueEffect
from tofcorr.simulation.options import CameraOptions, SensorOptions, ShotOptions, SimulatorOptions
from tofcorr.simulation.robot import CameraMountOptions
from tofcorr.simulation.scene import SceneOptions, UniformTarget
from tofcorr.simulation.signal import LightOptions, MeasuredErrorOptions, ReadoutOptions

Patterns = Mapping[str, Tensor]
"""Values of maps in all pixels, shape (cells,), metres, by the name of the effect."""

NO_PATTERNS: Patterns = MappingProxyType({})
# Modulation frequency of the simulator if the recording does not state one, Hz: a common one. The
# errors are tables of the distance, so that it hardly matters.
_DEFAULT_FREQUENCY = 20.0e6
# Reflectivity that the light is computed for: that of a grey wall.
_REFLECTIVITY = 0.5


def solution_of(study: Study, named: NamedEffects | None) -> tuple[Tensor, Tensor]:
    """Return the hand-eye transform (4, 4) and the error model's coefficients (K,) of a model.

    Args:
        study: The recording.
        named: The model with effects; None: the base model alone.
    """
    fit = study.fit
    if named is None:
        return fit.tool_from_camera, fit.coefficients
    theta = named.study.sums.ols.solve(named.columns)
    pose = fit.tool_from_camera
    if fit.model.hand_eye_free:
        pose = pose @ se3.exp(theta[: fit.model.num_hand_eye])
    return pose, fit.coefficients + theta[fit.model.num_geometry : fit.model.num_columns]


def observed_by(study: Study, named: NamedEffects | None) -> Observations:
    """Return the observations with estimated walls where a model has them.

    Args:
        study: The recording.
        named: The model with effects; None: the base model alone.
    """
    if named is None:
        return study.observations
    theta = named.study.sums.ols.solve(named.columns)
    return study.fit.model.moved(theta).observations


def fitted_effects(
    study: Study, named: NamedEffects, patterns: Patterns = NO_PATTERNS
) -> list[CatalogueEffect]:
    """Return the effects of the final model with their fitted coefficients.

    Args:
        study: The recording.
        named: The model.
        patterns: Values of maps in all pixels; those of other maps are zero outside the pixels
            that the diagnosis chose.
    """
    fitted = fitted_coefficients(named.study, named.columns)
    effects: list[CatalogueEffect] = [
        named.study.candidates.effects[name].with_coefficients(c) for name, c in fitted.items()
    ]
    for name in named.names:
        if name in study.candidates.maps:
            effect = study.candidates.maps[name]
            values = patterns.get(name)
            if values is None:
                # Estimated from all poses; cross-fitted values were subtracted.
                values = whole_map(study, effect, study.system.residual_of(named.columns))
            effects.append(effect.with_coefficients(values))
    return effects


def tables_of(
    study: Study, named: NamedEffects | None, given: SimulatorOptions | None
) -> ErrorTables:
    """Return the error model of a model as tables, added to those of a given simulator."""
    already = MeasuredErrorOptions() if given is None else given.sensor.delays.measured
    return error_tables(study, solution_of(study, named)[1], already)


def simulator_of(
    study: Study,
    named: NamedEffects | None,
    given: SimulatorOptions | None,
    patterns: Patterns = NO_PATTERNS,
) -> SimulatorOptions:
    """Return the simulator that the fit describes.

    Args:
        study: The recording.
        named: With these effects; None: base model alone.
        given: The simulator under diagnosis, to which the refitted errors are added; None: one
            made from the recording alone.
        patterns: As in `fitted_effects`.
    """
    recording = study.observations.recording
    pose = solution_of(study, named)[0]
    options = _plain(recording, study.observations, study.fit) if given is None else given
    measured = tables_of(study, named, given).tables
    delays = options.sensor.delays.model_copy(update={"measured": measured})
    sensor = options.sensor.model_copy(update={"delays": delays})
    effects = tuple(options.effects)
    if study.pattern is not None:
        effects += (study.pattern.to_mapping(),)
    if named is not None:
        effects += tuple(effect.to_mapping() for effect in fitted_effects(study, named, patterns))
    changes: dict[str, Any] = {
        "sensor": sensor,
        "effects": effects,
        "hand_eye": CameraMountOptions.from_matrix(pose),
    }
    return options.model_copy(update=changes)


def _plain(recording: Recording, observations: Observations, fit: BaseFit) -> SimulatorOptions:
    """Return a sensor without errors, as noisy as the recording, with its targets and frames."""
    names = sorted(set(recording.frames.target.tolist()))
    counts = {name: int((recording.frames.target == name).sum()) for name in names}
    frequency = recording.modulation_frequency or _DEFAULT_FREQUENCY
    light = LightOptions()
    electrons_per_count = ReadoutOptions().electrons_per_count
    electrons_at_1m = light.electrons_at_1m
    if observations.amplitude is not None:
        amplitude = float(observations.amplitude.median())
        scale = unambiguous_range(frequency) / (2 * np.pi)
        noise = float(fit.sigma.median())
        # Shot noise: sigma = scale sqrt(B / 2) / A, with the mean B = A / contrast.
        electrons = scale**2 / (2 * light.demodulation_contrast * noise**2)
        electrons_per_count = max(electrons / max(amplitude, 1e-12), 1e-9)
        distance = float(observations.measured.median())
        electrons_at_1m = electrons * distance**2 / (_REFLECTIVITY * light.demodulation_contrast)
    return SimulatorOptions(
        camera=CameraOptions.of(recording.camera),
        depth_kind=recording.depth_kind,
        shots=tuple(ShotOptions(target=name, poses=n) for name, n in counts.items()),
        scene=SceneOptions(
            targets={name: UniformTarget() for name in names} | SceneOptions().targets
        ),
        sensor=SensorOptions(
            modulation_frequency_hz=frequency,
            light=light.model_copy(update={"electrons_at_1m": electrons_at_1m}),
            readout=ReadoutOptions(
                electrons_per_count=electrons_per_count,
                read_noise_electrons=0.0,
                converter_bits=32,
            ),
        ),
    )
