"""The simulator that a fit describes: its options can be written out, and run at the same poses."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from tofcorr.data.recording import Recording
from tofcorr.diagnosis.findings.absorption import fitted_coefficients
from tofcorr.diagnosis.findings.naming import NamedEffects
from tofcorr.diagnosis.sums.base_fit import BaseFit
from tofcorr.diagnosis.sums.gains import FittedMap
from tofcorr.diagnosis.sums.observations import Observations, predicted_distance
from tofcorr.diagnosis.sums.study import Study
from tofcorr.error_terms.base import SignalTerm
from tofcorr.geometry import se3
from tofcorr.geometry.rays import ray_directions, unambiguous_range
from tofcorr.simulation.effects import CatalogueEffect, MapEffect
from tofcorr.simulation.options import (
    CameraMountOptions,
    CameraOptions,
    SensorOptions,
    ShotOptions,
    SimulatorOptions,
)
from tofcorr.simulation.scene import SceneOptions, UniformTarget
from tofcorr.simulation.signal import (
    AmplitudeTable,
    Curve,
    CurveTable,
    LatticeTable,
    LightOptions,
    MeasuredErrorOptions,
    ReadoutOptions,
    image_from_lattice,
)
from tofcorr.simulation.simulator import twin_frames

# Knots of the distance curve at the least, beside twice the coefficients of a term, so that splines
# and harmonics are resolved; knots of the amplitude curve; points of the pixel lattice a side.
# Chosen; a test compares simulator and fit to 0.2 mm.
_LEAST_KNOTS, _AMPLITUDE_KNOTS, _LATTICE = 13, 26, 9

Variable = Literal["distance", "amplitude", "normalised_amplitude"]
Numbered = tuple[Any, Tensor]
"""A term, and the numbers of its coefficients in the model."""


def tables_of(
    study: Study, named: NamedEffects | None, given: SimulatorOptions | None
) -> tuple[MeasuredErrorOptions, list[Numbered]]:
    """Return a fitted error model as tables, added to those that a given simulator has.

    The simulator has one table of the distance, one of the image, and one of the amplitude or the
    normalised amplitude. Terms of conditions, of distance and amplitude together, or of a second
    amplitude variable fit into none.

    Returns:
        The tables, and the terms that fit into none.
    """
    already = MeasuredErrorOptions() if given is None else given.sensor.delays.measured
    coefficients, model, start = solution_of(study, named)[1], study.fit.model, 1
    numbered: list[Numbered] = []
    for term in model.terms:
        numbered.append((term, torch.arange(start, start + len(term.symbols))))
        start += len(term.symbols)
    count, pixels = len(model.error_model.signal_terms), len(model.error_model.pixel_terms)
    signal, rest = numbered[:count], numbered[count:]
    of_pixels, beyond = rest[:pixels], rest[pixels:]
    reads = [_variable_of(term, study.observations) for term, _ in signal]
    variable = next((one for one in reads if one in ("amplitude", "normalised_amplitude")), None)
    if already.amplitude is not None:
        variable = already.amplitude.variable
    by_distance = [each for each, one in zip(signal, reads, strict=True) if one == "distance"]
    by_amplitude = [each for each, one in zip(signal, reads, strict=True) if one == variable]
    known = ("distance", variable)
    beyond += [each for each, one in zip(signal, reads, strict=True) if one not in known or not one]

    def total(terms: Sequence[Numbered], first: Tensor, second: Tensor) -> Tensor:
        found = torch.zeros(len(first), dtype=torch.float64)
        for term, numbers in terms:
            found = found + coefficients[numbers] @ term.basis(first, second).detach()
        return found

    def curve(at: Tensor, values: Tensor, known: CurveTable | None) -> dict[str, Any]:
        if known is not None:
            values = values + Curve(known.knots, known.values_m)(at)
        return {"knots": tuple(at.tolist()), "values_m": tuple(values.tolist())}

    measured, seen = study.observations.measured, study.observations.amplitude
    finest = max((len(numbers) for _, numbers in by_distance), default=0)
    count = max(_LEAST_KNOTS, 2 * finest + 1)
    at = torch.linspace(float(measured.min()), float(measured.max()), count, dtype=torch.float64)
    distance = CurveTable(**curve(at, total(by_distance, at, at), already.distance))
    amplitude = already.amplitude
    if by_amplitude and variable is not None and seen is not None:
        at = _dense_where_dark(seen if variable == "amplitude" else seen * measured**2)
        values = total(by_amplitude, torch.ones_like(at), at)
        found = curve(at, values, amplitude) | {"variable": variable}
        amplitude = AmplitudeTable.model_validate(found)
    camera = study.observations.recording.camera
    sides = (torch.linspace(0, end - 1, _LATTICE).double() for end in (camera.height, camera.width))
    lattice = total(of_pixels, *torch.cartesian_prod(*sides).T).reshape(_LATTICE, _LATTICE)
    if already.pixel is not None:
        lattice = lattice + image_from_lattice(already.pixel.values_m, _LATTICE, _LATTICE)
    tables = {
        "constant_m": float(coefficients[0]) + already.constant_m,
        "distance": distance,
        "pixel": LatticeTable(values_m=tuple(map(tuple, lattice.tolist()))),
        "amplitude": amplitude,
    }
    return already.model_copy(update=tables), beyond


def _dense_where_dark(values: Tensor) -> Tensor:
    """Return the knots of a curve over amplitudes: it bends most at dark pixels."""
    low = float(values.min())
    # An amplitude that never changes still needs knots that do.
    reach = max(float(values.max()) - low, max(abs(low), 1.0) / 1000)
    return low + reach * torch.linspace(0.0, 1.0, _AMPLITUDE_KNOTS, dtype=torch.float64) ** 2


def _variable_of(term: SignalTerm, observations: Observations) -> Variable | None:
    """Return the one variable that a term depends on; None: it depends on two."""
    if not term.needs_amplitude:
        return "distance"
    if observations.amplitude is None:
        return None
    low, high = float(observations.measured.min()), float(observations.measured.max())
    dark, bright = float(observations.amplitude.min()), float(observations.amplitude.max())
    amplitude = torch.linspace(dark, bright, 9, dtype=torch.float64)
    near, far = torch.full_like(amplitude, low), torch.full_like(amplitude, high)
    if torch.equal(term.basis(near, amplitude), term.basis(far, amplitude)):
        return "amplitude"
    same_normalised = amplitude * (low / high) ** 2
    if torch.allclose(term.basis(near, amplitude), term.basis(far, same_normalised)):
        return "normalised_amplitude"
    return None


Patterns = Mapping[str, Tensor]
"""Values of maps in all pixels, shape (cells,), metres, by the name of the effect."""

NO_PATTERNS: Patterns = MappingProxyType({})
# Pixels that are simulated at most, and frames at least: of larger recordings only some frames are
# simulated, evenly spread. Chosen to bound the time.
_MOST_PIXELS, _LEAST_FRAMES = 6_000_000, 8


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
                residual = study.system.residual_of(named.columns)
                values = FittedMap(study, effect, residual).whole()
            effects.append(effect.with_coefficients(values))
    return effects


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
    measured = tables_of(study, named, given)[0]
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
    # A common frequency; errors are tables of the distance, so that it hardly matters.
    frequency = recording.modulation_frequency or 20.0e6
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
        # Of a grey wall, which reflects a half.
        electrons_at_1m = electrons * distance**2 / (0.5 * light.demodulation_contrast)
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


def simulated_frames(recording: Recording) -> list[int]:
    """Return the frames to simulate: all, or as many as do not take long."""
    frames = recording.num_frames
    size = recording.camera.height * recording.camera.width
    most = max(_LEAST_FRAMES, _MOST_PIXELS // size)
    if frames <= most:
        return list(range(frames))
    return torch.linspace(0, frames - 1, most).round().long().unique().tolist()


def fitted_distance(
    study: Study,
    named: NamedEffects | None,
    given: SimulatorOptions | None,
    generator: torch.Generator | None = None,
    frames: list[int] | None = None,
) -> Tensor:
    """Return what the fitted simulator measures in the chosen pixels, shape (M,), metres.

    The error that frames of another simulator showed is added to its distances, and so are errors
    of base terms that it has no table for.

    Args:
        study: The recording.
        named: With these effects; None: base model alone.
        given: The simulator under diagnosis; None: one made from the recording alone.
        generator: Source of noise; None: the expected measurement.
        frames: Which frames; None: all.

    Returns:
        NaN in frames left out and where the simulated camera has no distance.
    """
    pose = solution_of(study, named)[0]
    simulator = simulator_of(study, named, given)
    observations = observed_by(study, named)
    distance = twin_distance(observations, simulator, pose, generator, frames)
    if given is None and study.fit.known is not None:
        distance = distance + study.fit.known.error
    beyond, coefficients = tables_of(study, named, given)[1], solution_of(study, named)[1]
    if beyond:
        numbers = torch.cat([own for _, own in beyond])
        columns = study.fit.model.error_columns(predicted_distance(observations, pose))
        distance = distance + columns[:, numbers] @ coefficients[numbers]
    return distance


def twin_distance(
    observations: Observations,
    simulator: SimulatorOptions,
    tool_from_camera: Tensor,
    generator: torch.Generator | None = None,
    frames: list[int] | None = None,
) -> Tensor:
    """Return what a simulated camera measures in the chosen pixels, shape (M,), metres.

    Args:
        observations: Poses, brightness and chosen pixels.
        simulator: What to run.
        tool_from_camera: Hand-eye transform, shape (4, 4).
        generator: Source of noise; None: the expected measurement.
        frames: Which frames; None: all.

    Returns:
        NaN in frames left out and where the simulated camera has no distance.
    """
    recording = observations.recording
    known = observations.amplitude is not None
    measured = torch.full_like(observations.measured, torch.nan)
    chosen = list(range(observations.num_frames)) if frames is None else frames
    ends = observations.frame_ends
    states = twin_frames(
        simulator,
        recording,
        generator,
        tool_from_camera=tool_from_camera,
        reflectivity="from_recording" if known else "pattern",
        indices=chosen,
    )
    for frame, state in zip(chosen, states, strict=True):
        start, end = ends[frame]
        pixels = observations.pixel[start:end]
        measured[start:end] = state.measured_distance.reshape(-1)[pixels]
    return measured


def whole_patterns(
    study: Study, named: NamedEffects, given: SimulatorOptions | None
) -> dict[str, Tensor]:
    """Return the maps of the model, with values in all pixels, by name; metres.

    Of large images the diagnosis chooses some pixels, and knows a map in these alone. A simulator
    and a sensor need it everywhere. So the simulator without the map is run at the recording's
    poses, and a pixel's value is the weighted mean of what it measures too little, shrunk towards
    zero by the prior of all maps. Each frame's own offset and tilt is taken off before.

    Nothing is returned where all pixels were chosen, or where the built-in simulator cannot do all
    that the model does: other pixels have the value zero then.

    Args:
        study: The recording, before any effect was named.
        named: The effects named.
        given: The simulator under diagnosis; None: one made from the recording alone.
    """
    maps = [study.candidates.maps[name] for name in named.names if name in study.candidates.maps]
    rendered = given is None and study.fit.known is not None
    if not maps or not study.observations.is_sample or rendered:
        return {}
    if tables_of(study, named, given)[1]:
        return {}
    return {effect.name: _of_all_pixels(study, named, given, effect) for effect in maps}


def _of_all_pixels(
    study: Study, named: NamedEffects, given: SimulatorOptions | None, effect: MapEffect
) -> Tensor:
    """Return the value of each cell from all pixels, shape (cells,), metres."""
    observations = study.observations
    camera = observations.recording.camera
    others = replace(named, names=tuple(name for name in named.names if name != effect.name))
    spread = FittedMap(study, effect, study.system.residual_of(named.columns)).prior_sd
    frames, usable = simulated_frames(observations.recording), observations.usable
    weights = torch.zeros(observations.num_frames, dtype=torch.float64)
    weights = weights.index_add(0, observations.frame, study.fit.weight)
    weights = weights / torch.bincount(observations.frame, minlength=len(weights)).clamp(min=1)
    states = twin_frames(
        simulator_of(study, others, given),
        observations.recording,
        tool_from_camera=solution_of(study, others)[0],
        reflectivity="pattern" if observations.amplitude is None else "from_recording",
        indices=frames,
    )
    x, y, _ = ray_directions(camera).reshape(-1, 3).T
    surface = torch.stack([torch.ones_like(x), x, y], dim=1)
    cells = effect.cells_of(torch.arange(camera.height * camera.width))
    sums, total = torch.zeros(2, len(effect.coefficients), dtype=torch.float64)
    for frame, state in zip(frames, states, strict=True):
        measured = observations.distance_images[frame].double()
        left = (measured - state.measured_distance).flatten()
        used = usable[frame].flatten() & left.isfinite()
        if not bool(used.any()):
            continue
        own, left = surface[used], left[used]
        left = left - own @ torch.linalg.lstsq(own, left[:, None]).solution[:, 0]
        weight = weights[frame]
        # Three standard deviations of noise and map: flying pixels are farther off.
        farthest = 3 * float(1 / weight + spread**2) ** 0.5
        left = weight * left.clamp(-farthest, farthest)
        for cell in cells[used].unbind(1):
            sums.index_add_(0, cell, left)
            total.index_add_(0, cell, weight.expand_as(left))
    return sums / (total + spread**-2)
