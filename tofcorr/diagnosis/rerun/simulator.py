"""The fitted error model as tables of the simulator, and what of it fits into no table."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any, Generic, Literal, NamedTuple, TypeVar

import numpy as np
import torch
from torch import Tensor

from tofcorr.data.recording import Recording
from tofcorr.diagnosis.findings.absorption import fitted_coefficients
from tofcorr.diagnosis.findings.naming import NamedEffects
from tofcorr.diagnosis.sums.base_fit import BaseFit
from tofcorr.diagnosis.sums.base_model import BaseModel
from tofcorr.diagnosis.sums.map_gain import map_spread, pixel_weight, whole_map
from tofcorr.diagnosis.sums.observations import Observations, predicted_distance
from tofcorr.diagnosis.sums.study import Study
from tofcorr.error_terms.base import PixelTerm, SignalTerm, Term
from tofcorr.geometry import se3
from tofcorr.geometry.ranges import unambiguous_range
from tofcorr.geometry.rays import ray_directions
from tofcorr.simulation.effects import CatalogueEffect, MapEffect
from tofcorr.simulation.options import CameraOptions, SensorOptions, ShotOptions, SimulatorOptions
from tofcorr.simulation.robot import CameraMountOptions
from tofcorr.simulation.scene import SceneOptions, UniformTarget
from tofcorr.simulation.signal import (
    AmplitudeTable,
    CurveTable,
    LatticeTable,
    LightOptions,
    MeasuredErrorOptions,
    ReadoutOptions,
    image_from_lattice,
)
from tofcorr.simulation.twin import twin_frames

# Knots of the distance curve: this many at least, and twice the coefficients of a term, so that a
# spline or a harmonic is resolved. Knots of the amplitude curve; points of the pixel lattice a
# side. Chosen; a test compares simulator and fit to 0.2 mm.
_LEAST_KNOTS = 13
_KNOTS_PER_COEFFICIENT = 2
_AMPLITUDE_KNOTS = 26
_LATTICE = 9
_LEAST_REACH = 1e-3
"""Least range of the knots over the amplitude, as a share of the smallest amplitude. Chosen: no
recording that changes at all has less."""

Variable = Literal["amplitude", "normalised_amplitude"]


TermT = TypeVar("TermT", bound=Term)


class _Fitted(NamedTuple, Generic[TermT]):
    """A term, the numbers of its coefficients in the model, and their values."""

    term: TermT
    numbers: Tensor
    values: Tensor


@dataclass(frozen=True, kw_only=True)
class ErrorTables:
    """A fitted error model, as far as the simulator has tables for it.

    Attributes:
        tables: The tables.
        beyond: Kinds of the terms that fit into no table.
        numbers: Numbers of their coefficients in the model, int64.
        coefficients: Of the whole model, shape (K,), metres.
    """

    tables: MeasuredErrorOptions
    beyond: tuple[str, ...]
    numbers: Tensor
    coefficients: Tensor

    def error_beyond(self, model: BaseModel, distance: Tensor) -> Tensor:
        """Return the error that the tables lack, at predicted distances (M,), metres."""
        columns = model.error_columns(distance)[:, self.numbers]
        return columns @ self.coefficients[self.numbers]


def error_tables(study: Study, coefficients: Tensor, already: MeasuredErrorOptions) -> ErrorTables:
    """Return the error model as tables, added to those that the simulator has.

    The simulator has one table of the distance, one of the image, and one of the amplitude or the
    normalised amplitude. Terms of conditions, of distance and amplitude together, or of a second
    amplitude variable fit into none.

    Args:
        study: The recording.
        coefficients: Of constant and terms, shape (K,), metres.
        already: Tables that the simulator has.
    """
    model = study.fit.model
    signal = _with_coefficients(model.signal_terms, coefficients, 1)
    after_signal = 1 + sum(len(each.numbers) for each in signal)
    pixel = _with_coefficients(model.pixel_terms, coefficients, after_signal)
    after_pixel = after_signal + sum(len(each.numbers) for each in pixel)
    beyond: list[_Fitted[Any]] = [
        *_with_coefficients(model.condition_terms, coefficients, after_pixel)
    ]
    by_distance, by_amplitude = [], []
    variable = None if already.amplitude is None else already.amplitude.variable
    for each in signal:
        if not each.term.needs_amplitude:
            by_distance.append(each)
            continue
        reads = _variable_of(each.term, study.observations)
        if reads is None or variable not in (None, reads):
            beyond.append(each)
        else:
            by_amplitude.append(each)
            variable = reads
    tables = {
        "constant_m": float(coefficients[0]) + already.constant_m,
        "distance": _distance_curve(study, by_distance, already.distance),
        "pixel": _pixel_lattice(study, pixel, already.pixel),
        "amplitude": _amplitude_curve(study, by_amplitude, variable, already.amplitude),
    }
    nothing = torch.zeros(0, dtype=torch.int64)
    return ErrorTables(
        tables=already.model_copy(update=tables),
        beyond=tuple(each.term.options.kind for each in beyond),
        numbers=torch.cat([nothing, *(each.numbers for each in beyond)]),
        coefficients=coefficients,
    )


def _with_coefficients(
    terms: Sequence[TermT], coefficients: Tensor, start: int
) -> list[_Fitted[TermT]]:
    """Return terms with their coefficients, of which the first has the number `start`."""
    found = []
    for term in terms:
        numbers = torch.arange(start, start + len(term.symbols))
        found.append(_Fitted(term, numbers, coefficients[numbers]))
        start += len(term.symbols)
    return found


def _variable_of(term: SignalTerm, observations: Observations) -> Variable | None:
    """Return the one variable that a term of the amplitude depends on; None: it depends on two."""
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


def _distance_curve(
    study: Study, terms: Sequence[_Fitted[SignalTerm]], already: CurveTable | None
) -> CurveTable:
    measured = study.observations.measured
    finest = max((len(each.numbers) for each in terms), default=0)
    count = max(_LEAST_KNOTS, _KNOTS_PER_COEFFICIENT * finest + 1)
    knots = np.linspace(float(measured.min()), float(measured.max()), count)
    values = np.zeros(count)
    at = torch.from_numpy(knots)
    for each in terms:
        values += (each.values @ each.term.basis(at, at).detach()).numpy()
    if already is not None:
        values = values + already.curve()(at).numpy()
    return CurveTable(knots=tuple(knots.tolist()), values_m=tuple(values.tolist()))


def _amplitude_curve(
    study: Study,
    terms: Sequence[_Fitted[SignalTerm]],
    variable: Variable | None,
    already: AmplitudeTable | None,
) -> AmplitudeTable | None:
    observations = study.observations
    if not terms or variable is None or observations.amplitude is None:
        return already
    values = observations.amplitude
    if variable == "normalised_amplitude":
        values = values * observations.measured**2
    # The curve bends most at dark pixels, so knots are dense there.
    low = float(values.min())
    # An amplitude that never changes still needs knots that do.
    reach = max(float(values.max()) - low, _LEAST_REACH * max(abs(low), 1.0))
    knots = low + reach * np.linspace(0.0, 1.0, _AMPLITUDE_KNOTS) ** 2
    at = torch.from_numpy(knots)
    curve = np.zeros_like(knots)
    for each in terms:
        curve = curve + (each.values @ each.term.basis(torch.ones_like(at), at).detach()).numpy()
    if already is not None:
        curve = curve + already.curve()(at).numpy()
    return AmplitudeTable(
        knots=tuple(knots.tolist()), values_m=tuple(curve.tolist()), variable=variable
    )


def _pixel_lattice(
    study: Study, terms: Sequence[_Fitted[PixelTerm]], already: LatticeTable | None
) -> LatticeTable:
    """Return the pixel terms on a lattice from corner to corner."""
    camera = study.observations.recording.camera
    rows = torch.linspace(0, camera.height - 1, _LATTICE).double()
    columns = torch.linspace(0, camera.width - 1, _LATTICE).double()
    at = torch.cartesian_prod(rows, columns)
    values = np.zeros((_LATTICE, _LATTICE))
    for each in terms:
        own = each.values @ each.term.basis(at[:, 0], at[:, 1]).detach()
        values += own.reshape(_LATTICE, _LATTICE).numpy()
    if already is not None:
        values = values + image_from_lattice(already.values_m, _LATTICE, _LATTICE).numpy()
    return LatticeTable(values_m=tuple(tuple(row) for row in values.tolist()))


# --- A simulator that behaves as a fit describes: its options can be written out and run.


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


# --- The simulator run at the recording's own poses, sampled at the chosen pixels.


# Pixels that are simulated at most, and frames at least: of larger recordings only some frames are
# simulated, evenly spread. Chosen to bound the time.
_MOST_PIXELS = 6_000_000
_LEAST_FRAMES = 8


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
    tables = tables_of(study, named, given)
    if not tables.beyond:
        return distance
    predicted = predicted_distance(observations, pose)
    return distance + tables.error_beyond(study.fit.model, predicted)


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


# --- The maps of a model in all pixels of a large image, of which the diagnosis chose some.


# A residual counts as so many standard deviations of noise and map at most. Chosen: flying pixels
# are farther off.
_FARTHEST = 3.0


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
    if (
        not maps
        or not study.observations.is_sample
        or rendered
        or tables_of(study, named, given).beyond
    ):
        return {}
    return {effect.name: _of_all_pixels(study, named, given, effect) for effect in maps}


def _of_all_pixels(
    study: Study, named: NamedEffects, given: SimulatorOptions | None, effect: MapEffect
) -> Tensor:
    """Return the value of each cell from all pixels, shape (cells,), metres."""
    observations = study.observations
    camera = observations.recording.camera
    others = replace(named, names=tuple(name for name in named.names if name != effect.name))
    spread = map_spread(study, effect, study.system.residual_of(named.columns))
    frames, usable = simulated_frames(observations.recording), observations.usable
    weights = torch.zeros(observations.num_frames, dtype=torch.float64)
    weights = weights.index_add(0, observations.frame, pixel_weight(study))
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
    cells = effect.cells_of_image(camera.height, camera.width)
    sums, total = torch.zeros(2, effect.num_cells(effect.shape), dtype=torch.float64)
    for frame, state in zip(frames, states, strict=True):
        measured = observations.distance_images[frame].double()
        left = (measured - state.measured_distance).flatten()
        used = usable[frame].flatten() & left.isfinite()
        if not bool(used.any()):
            continue
        own, left = surface[used], left[used]
        left = left - own @ torch.linalg.lstsq(own, left[:, None]).solution[:, 0]
        weight = weights[frame]
        farthest = _FARTHEST * float(1 / weight + spread**2) ** 0.5
        left = weight * left.clamp(-farthest, farthest)
        for cell in cells[used].unbind(1):
            sums.index_add_(0, cell, left)
            total.index_add_(0, cell, weight.expand_as(left))
    return sums / (total + spread**-2)
