"""The simulator and the sensor that a fit describes.

The simulator's options can be written out, and run at the same poses. The sensor is the content of
`sensor.yaml`: the camera as a diagnosis found it.
"""

import copy
import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import accumulate, pairwise
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from tofcorr.data.recording import Recording
from tofcorr.diagnosis.findings.naming import NamedEffects
from tofcorr.diagnosis.findings.shares import HAND_EYE
from tofcorr.diagnosis.findings.where import Interval, interval_of
from tofcorr.diagnosis.sums.observations import TINY, Observations, predicted_distance
from tofcorr.diagnosis.sums.shared_noise import MOST_PIXELS
from tofcorr.diagnosis.sums.study import FittedMap, Study, fitted_coefficients
from tofcorr.error_terms.base import SignalTerm
from tofcorr.geometry import se3
from tofcorr.geometry.rays import unambiguous_range
from tofcorr.geometry.se3 import RigidTransform
from tofcorr.observables.compare import Observables
from tofcorr.pixels.sample import thinned
from tofcorr.sensor.model import section_of
from tofcorr.sensor.sensor_file import (
    ErrorSection,
    SensorFile,
    dropout_section,
    light_section,
    validity_of,
)
from tofcorr.simulation.effects import CatalogueEffect, MapEffect
from tofcorr.simulation.effects.multipath import second_bounces_state
from tofcorr.simulation.effects.registry import build_effects
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
# and harmonics are resolved; the amplitude curve has twice as many. And points of the pixel lattice
# a side. Chosen; a test compares simulator and fit to 0.2 mm.
_LEAST_KNOTS, _LATTICE = 13, 9

Numbered = tuple[Any, Tensor]
"""A term, and the numbers of its coefficients in the model."""


@dataclass(frozen=True, kw_only=True)
class Evidence:
    """What the findings were computed from; it describes a simulator.

    Attributes:
        study: The recording, before any effect was named.
        named: The effects named, with all comparisons.
        given: The built-in simulator under diagnosis, to which the refitted errors are added; None:
            they are added to one made from the recording alone.
        patterns: Values of maps in all pixels, shape (cells,), metres, by name, where the study has
            only some of them. Other maps are zero outside the pixels that the diagnosis chose.
    """

    study: Study
    named: NamedEffects
    given: SimulatorOptions | None = None
    patterns: Mapping[str, Tensor] = field(default_factory=dict)

    @cached_property
    def theta(self) -> Tensor:
        """Coefficients of the final model, as steps from the base fit, shape (K,)."""
        return self.named.study.sums.ols.solve(self.named.columns)

    @property
    def rendered(self) -> bool:
        """Whether another simulator than the built-in one rendered frames."""
        return self.given is None and self.study.fit.known is not None

    @property
    def tool_from_camera(self) -> Tensor:
        """Hand-eye transform of the final model, shape (4, 4)."""
        pose, count = self.study.fit.tool_from_camera, self.study.fit.model.num_hand_eye
        return pose @ se3.exp(self.theta[:count]) if count else pose

    @property
    def coefficients(self) -> Tensor:
        """Coefficients of the final model's constant and error terms, shape (K,)."""
        model = self.study.fit.model
        steps = self.theta[model.num_geometry : model.num_columns]
        return self.study.fit.coefficients + steps

    @property
    def observations(self) -> Observations:
        """The observations, with estimated walls where the final model has them."""
        return self.study.fit.model.moved(self.theta).observations

    @cached_property
    def effects(self) -> list[CatalogueEffect]:
        """The effects of the final model with their fitted coefficients."""
        study, named = self.study, self.named
        fitted = fitted_coefficients(named.study, named.columns)
        effects: list[CatalogueEffect] = [
            named.study.effects[name].with_coefficients(c) for name, c in fitted.items()
        ]
        for name in filter(study.maps.__contains__, named.names):
            values, effect = self.patterns.get(name), study.maps[name]
            if values is None:
                # Estimated from all poses; cross-fitted values were subtracted.
                residual = study.residual_of(named.columns)
                values = FittedMap(study, effect, residual).whole()
            effects.append(effect.with_coefficients(values))
        return effects

    def without_effects(self) -> "Evidence":
        """Return the same of the base model alone."""
        bare = replace(self.named, names=(), study=self.study)
        return replace(self, named=bare)

    def fitted_to(self, units: Tensor) -> "Evidence":
        """Return the same model fitted to some poses alone, bool (U,)."""
        columns, named = self.named.columns, self.named
        own, of_model = (fitted_to(study, units, columns) for study in (self.study, named.study))
        return replace(self, study=own, named=replace(named, study=of_model))

    @cached_property
    def tables(self) -> tuple[MeasuredErrorOptions, list[Numbered]]:
        """The error model as tables, added to those of a given simulator; terms without a table."""
        return _tables(self)

    @cached_property
    def simulator(self) -> SimulatorOptions:
        """The simulator that the fit describes."""
        pattern = self.study.pattern
        options = _plain(self.study) if self.given is None else self.given
        delays = options.sensor.delays.model_copy(update={"measured": self.tables[0]})
        own = [*([] if pattern is None else [pattern]), *self.effects]
        changes: dict[str, Any] = {
            "sensor": options.sensor.model_copy(update={"delays": delays}),
            "effects": (*options.effects, *(effect.to_mapping() for effect in own)),
            "hand_eye": mount_at(self.tool_from_camera),
        }
        return options.model_copy(update=changes)

    def distance(
        self, generator: torch.Generator | None = None, frames: list[int] | None = None
    ) -> Tensor:
        """Return what the simulator measures in the chosen pixels, as `twin_distance` does, (M,).

        The error that frames of another simulator showed is added to its distances, and so are
        errors of base terms that it has no table for.
        """
        observations, pose = self.observations, self.tool_from_camera
        distance = twin_distance(observations, self.simulator, pose, generator, frames)
        known = self.study.fit.known
        if known is not None and self.given is None:
            distance = distance + known.error
        for _, numbers in self.tables[1]:
            columns = self.study.fit.model.error_columns(predicted_distance(observations, pose))
            distance = distance + columns[:, numbers] @ self.coefficients[numbers]
        return distance


def fitted_to(study: Study, units: Tensor, names: Sequence[str]) -> Study:
    """Return the study with ordinary sums, and maps, of some poses alone.

    Args:
        study: The recording.
        units: Which poses, shape (U,), bool.
        names: Effects with columns that the model has; the sums of all others are left out.
    """
    used = units.double()
    sums = study.sums.of(names)
    sums = replace(sums, plain=sums.plain * used[:, None, None])
    fit = replace(study.fit, trust=study.fit.trust * used[study.unit_of_pixel])
    return replace(study, sums=sums, fit=fit)


def _tables(found: Evidence) -> tuple[MeasuredErrorOptions, list[Numbered]]:
    """Return `Evidence.tables`.

    The simulator has one table of the distance, one of the image, and one of the amplitude or the
    normalised amplitude. Terms of conditions, of distance and amplitude together, or of a second
    amplitude variable fit into none.
    """
    observations, model, given = found.study.observations, found.study.fit.model, found.given
    already = MeasuredErrorOptions() if given is None else given.sensor.delays.measured
    terms: list[Any] = model.error_model.terms()
    counts = len(model.error_model.signal_terms), len(model.error_model.pixel_terms)
    reads = [*map(_variable_of, terms[: counts[0]])]
    reads += ["pixel"] * counts[1] + [None] * (len(terms) - sum(counts))
    variable = next((one for one in reads if one in ("amplitude", "normalised_amplitude")), None)
    if already.amplitude is not None:
        variable = already.amplitude.variable
    ends = accumulate((len(term.symbols) for term in terms), initial=1)
    spans = zip(terms, reads, pairwise(ends), strict=True)
    numbered = [(read, term, torch.arange(*span)) for term, read, span in spans]

    def total(kind: str, first: Tensor, second: Tensor) -> Tensor:
        """Return the sum of all terms of one variable at values (N,) of a term's two."""
        own = [
            found.coefficients[numbers] @ term.basis(first, second).detach()
            for read, term, numbers in numbered
            if read == kind
        ]
        return torch.stack([torch.zeros(len(first), dtype=torch.float64), *own]).sum(0)

    def curve(at: Tensor, values: Tensor, known: CurveTable | None) -> dict[str, Any]:
        if known is not None:
            values = values + Curve(known.knots, known.values_m)(at)
        return {"knots": tuple(at.tolist()), "values_m": tuple(values.tolist())}

    measured, seen = observations.measured, observations.amplitude
    finest = max((len(numbers) for read, _, numbers in numbered if read == "distance"), default=0)
    count = max(_LEAST_KNOTS, 2 * finest + 1)
    at = torch.linspace(float(measured.min()), float(measured.max()), count, dtype=torch.float64)
    distance = CurveTable(**curve(at, total("distance", at, at), already.distance))
    amplitude = already.amplitude
    if variable is not None and variable in reads and seen is not None:
        bright = seen if variable == "amplitude" else seen * measured**2
        low, high = float(bright.min()), float(bright.max())
        # An amplitude that never changes still needs knots that do. Dark pixels need most.
        reach = max(high - low, max(abs(low), 1.0) / 1000)
        at = low + reach * torch.linspace(0.0, 1.0, 2 * _LEAST_KNOTS, dtype=torch.float64) ** 2
        values = total(variable, torch.ones_like(at), at)
        own = curve(at, values, amplitude) | {"variable": variable}
        amplitude = AmplitudeTable.model_validate(own)
    camera = observations.recording.camera
    sides = (torch.linspace(0, end - 1, _LATTICE).double() for end in (camera.height, camera.width))
    lattice = total("pixel", *torch.cartesian_prod(*sides).T).reshape(_LATTICE, _LATTICE)
    if already.pixel is not None:
        lattice = lattice + image_from_lattice(already.pixel.values_m, _LATTICE, _LATTICE)
    tables = {
        "constant_m": float(found.coefficients[0]) + already.constant_m,
        "distance": distance,
        "pixel": LatticeTable(values_m=tuple(map(tuple, lattice.tolist()))),
        "amplitude": amplitude,
    }
    held = ("distance", "pixel", *([] if variable is None else [variable]))
    beyond = [(term, numbers) for read, term, numbers in numbered if read not in held]
    return already.model_copy(update=tables), beyond


def _variable_of(term: SignalTerm) -> str | None:
    """Return the one variable that a term depends on; None: it depends on two."""
    if not term.needs_amplitude:
        return "distance"
    if len(term.axes() or ()) > 1:
        return None
    return "normalised_amplitude" if term.uses_normalised_amplitude else "amplitude"


def _plain(study: Study) -> SimulatorOptions:
    """Return a sensor without errors, as noisy as the recording, with its targets and frames."""
    observations, recording = study.observations, study.observations.recording
    shown = sorted(Counter(recording.frames.target.tolist()).items())
    targets = dict.fromkeys(dict(shown), UniformTarget()) | SceneOptions().targets
    # Errors are tables of the distance, so that a frequency that is unknown hardly matters.
    frequency = recording.modulation_frequency or SensorOptions().modulation_frequency_hz
    light, readout = LightOptions(), ReadoutOptions(read_noise_electrons=0.0, converter_bits=32)
    if observations.amplitude is not None:
        amplitude = float(observations.amplitude.median())
        scale = unambiguous_range(frequency) / (2 * np.pi)
        noise = float(study.fit.sigma.median())
        # Shot noise: sigma = scale sqrt(B / 2) / A, with the mean B = A / contrast.
        electrons = scale**2 / (2 * light.demodulation_contrast * noise**2)
        per_count = {"electrons_per_count": electrons / max(amplitude, TINY)}
        readout = readout.model_copy(update=per_count)
        distance = float(observations.measured.median())
        # Of a grey wall, which reflects a half.
        at_1m = electrons * distance**2 / (0.5 * light.demodulation_contrast)
        light = light.model_copy(update={"electrons_at_1m": at_1m})
    return SimulatorOptions(
        camera=CameraOptions(**recording.camera.section()),
        depth_kind=recording.depth_kind,
        shots=tuple(ShotOptions(target=name, poses=count) for name, count in shown),
        scene=SceneOptions(targets=targets),
        sensor=SensorOptions(modulation_frequency_hz=frequency, light=light, readout=readout),
    )


def mount_at(tool_from_camera: Tensor) -> CameraMountOptions:
    """Return the options of a simulator whose true hand-eye transform is this one, (4, 4)."""
    return CameraMountOptions(
        translation_mm=tuple((1e3 * tool_from_camera[:3, 3]).tolist()),
        rotation_deg=tuple(torch.rad2deg(se3.log(tool_from_camera)[3:]).tolist()),
    )


def simulated_frames(recording: Recording) -> list[int]:
    """Return the frames to simulate: all, or as many as do not take long."""
    frames, camera = recording.num_frames, recording.camera
    most = max(MOST_PIXELS // (camera.height * camera.width), 1)
    return thinned(np.arange(frames), most).tolist()


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
    measured = torch.full_like(observations.measured, torch.nan)
    chosen = list(range(observations.num_frames)) if frames is None else frames
    states = twin_frames(
        simulator,
        observations.recording,
        generator,
        tool_from_camera=tool_from_camera,
        reflectivity="pattern" if observations.amplitude is None else "from_recording",
        indices=chosen,
    )
    for frame, state in zip(chosen, states, strict=True):
        start, end = observations.frame_ends[frame]
        measured[start:end] = state.measured_distance.reshape(-1)[observations.pixel[start:end]]
    return measured


def whole_patterns(found: Evidence) -> dict[str, Tensor]:
    """Return the maps of the model, with values in all pixels, by name; metres.

    Of large images the diagnosis chooses some pixels, and knows a map in these alone. A simulator
    and a sensor need it everywhere. So the simulator without the map is run at the recording's
    poses, and a pixel's value is the weighted mean of what it measures too little, shrunk towards
    zero by the prior of all maps. Each frame's own offset and tilt is taken off before.

    Nothing is returned where all pixels were chosen, or where the built-in simulator cannot do all
    that the model does: other pixels have the value zero then.
    """
    maps = found.study.maps
    names = [name for name in found.named.names if name in maps]
    cannot = not names or not found.study.observations.is_sample or found.rendered
    if cannot or found.tables[1]:
        return {}
    return {name: _of_all_pixels(found, maps[name]) for name in names}


def _of_all_pixels(found: Evidence, effect: MapEffect) -> Tensor:
    """Return the value of each cell from all pixels, shape (cells,), metres."""
    study, named, observations = found.study, found.named, found.study.observations
    names = tuple(name for name in named.names if name != effect.name)
    others = replace(found, named=replace(named, names=names))
    spread = FittedMap(study, effect, study.residual_of(named.columns)).prior_sd
    frames, pose = simulated_frames(observations.recording), others.tool_from_camera
    number, pixel = observations.usable[frames].flatten(1).nonzero(as_tuple=True)
    whole = observations.choosing(torch.tensor(frames)[number], pixel)
    left = whole.measured - twin_distance(whole, others.simulator, pose, None, frames)
    whole, left = whole.at(left.isfinite()), left[left.isfinite()]
    surface = torch.cat([torch.ones_like(left)[:, None], whole.rays[:, :2]], dim=1)
    for frame in whole.frame.unique().tolist():
        part = slice(*whole.frame_ends[frame])
        tilt = torch.linalg.lstsq(surface[part], left[part, None]).solution
        left[part] -= (surface[part] @ tilt)[:, 0]
    seen, count = observations.frame, observations.num_frames
    weights = torch.bincount(seen, study.fit.weight, count)
    weight = (weights / torch.bincount(seen, minlength=count).clamp(min=1))[whole.frame]
    # Three standard deviations of noise and map: flying pixels are farther off.
    farthest = 3 * (1 / weight + spread**2).sqrt()
    left = weight * left.clamp(-farthest, farthest)
    sums, total = torch.zeros(2, len(effect.coefficients), dtype=torch.float64)
    for cell in effect.cells_of(whole.pixel).unbind(1):
        sums.index_add_(0, cell, left)
        total.index_add_(0, cell, weight)
    return sums / (total + spread**-2)


def sensor_of(found: Evidence, observables: Observables | None) -> SensorFile:
    """Return the sensor that a diagnosis found: base terms, named effects, noise, missing pixels.

    Args:
        found: The final model.
        observables: Noise and missing pixels of the recording; None: the sensor has neither.
    """
    study, model = found.study, found.study.fit.model
    recording = study.observations.recording
    own: list[CatalogueEffect] = [] if study.pattern is None else [study.pattern]
    states = [
        second_bounces_state(effect, recording.modulation_frequency) for effect in found.effects
    ]
    own += [effect for effect, state in zip(found.effects, states, strict=True) if state is None]
    entries = [effect.in_other_recordings().to_mapping() for effect in own]
    error, remainder = given_error(found)
    terms, error_model = model.options.with_columns().terms, copy.deepcopy(model.error_model)
    error_model.set_coefficient_vector(found.coefficients + error)
    # Effects and further light move what is measured, but not what the terms are functions of.
    distance = predicted_distance(found.observations, found.tool_from_camera)
    true = {"true_radial_distance_m": tuple(torch.stack(distance.aminmax()).tolist())}
    sentences = [
        f"{study.observations.num_units} poses, {recording.num_frames} frames.",
        *([] if found.named.names else ["No effect beyond the error terms was found."]),
    ]
    if 1e4 * remainder > study.options.target_gap_mm:  # A tenth of it.
        sentences.append(
            f"The simulator under diagnosis makes an error of {1e3 * remainder:.1f} mm RMS that no "
            "term or effect of this file holds."
        )
    return SensorFile(
        format="tofcorr-sensor",
        version=1,
        title="A time-of-flight camera, as a diagnosis found it.",
        measured_from=tuple(sentences),
        camera=CameraOptions(**recording.camera.section()),
        depth_kind=recording.depth_kind,
        modulation_frequency_hz=recording.modulation_frequency,
        tool_from_camera=cast(RigidTransform, tuple(map(tuple, found.tool_from_camera.tolist()))),
        error=section_of(error_model, ErrorSection(reads="true_distance", terms=terms)),
        effects=(*_given_effects(found), *entries),
        **({} if observables is None else _sections(study, observables, own)),
        validity=validity_of(model.domain).model_copy(update=true),
        second_bounces=next(filter(None, states), None),
    )


def _given_effects(found: Evidence) -> tuple[dict[str, Any], ...]:
    return () if found.given is None else tuple(map(dict, found.given.effects))


def given_error(found: Evidence) -> tuple[Tensor, float]:
    """Return a given simulator's own error as coefficients of the base terms, and what is left.

    Without a given simulator both are zero.

    Returns:
        Shape (K,), metres; root mean square of the rest, metres.
    """
    study = found.study
    fit, observations = study.fit, study.observations
    if fit.known is None:
        return torch.zeros_like(fit.coefficients), 0.0
    distance = predicted_distance(observations, fit.tool_from_camera)
    columns = fit.model.error_columns(distance)
    known = observations.measured - fit.residual - distance - columns @ fit.coefficients
    for effect in build_effects(_given_effects(found)):
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
    if observables.real_noise.observed.recording is not recording:
        # Its planes were estimated with the rest.
        observables = Observables(recording, None, seed=study.options.seed)
    curve, observed = observables.real_noise.curve, observables.real_noise.observed
    return {
        # The fixed part may stand among the effects, pixel by pixel.
        "noise": curve.with_fixed_share(0.0) if pattern else curve,
        "dropouts": dropout_section(observables.real_dropouts.model, observed),
        "light": light_section(observed),
    }


@dataclass(frozen=True)
class FittedValue:
    """One parameter of the final model.

    Attributes:
        cause: `hand_eye`, a group of the base model's terms, or an effect.
        kind: `parameter` or `effect`.
        name: Its symbol, as in sensor.yaml.
        unit: As in sensor.yaml.
        value: The estimate.
        interval: 95 %, with poses as the unit; None for a map, of which the size is given.
    """

    cause: str
    kind: str
    name: str
    unit: str
    value: float
    interval: Interval | None


def fitted_values(found: Evidence, resamples: Tensor) -> tuple[FittedValue, ...]:
    """Return hand-eye transform, coefficients of the base terms, and those of the named effects.

    Args:
        found: The final model.
        resamples: How often each resample holds each pose, shape (B, U).
    """
    gram, score, prior = found.named.study.sums.ols.of(found.named.columns)
    normal = torch.tensordot(resamples, gram, dims=1) + prior
    draws = torch.linalg.solve(normal, (resamples @ score)[..., None])[..., 0]
    values = []
    thetas = torch.cat([found.theta[None], draws])
    for cause, kind, name, unit, (value, *drawn) in _parameters(found, thetas):
        known = bool(drawn) and all(map(math.isfinite, (value, *drawn)))
        interval = interval_of(drawn, value) if known else None
        values.append(FittedValue(cause, kind, name, unit, value, interval))
    return tuple(values)


def _parameters(
    found: Evidence, thetas: Tensor
) -> Iterator[tuple[str, str, str, str, list[float]]]:
    """Yield cause, kind, name and unit of each parameter, its estimate, and those of resamples.

    Args:
        found: The final model.
        thetas: The estimate of all columns and those of the resamples, shape (1 + B, K).
    """
    model, fit, given = found.study.fit.model, found.study.fit, given_error(found)[0]
    if model.num_hand_eye:
        poses = fit.tool_from_camera @ se3.exp(thetas[:, : model.num_hand_eye])
        turns = torch.rad2deg(se3.log(poses)[:, 3:])
        for place, axis in enumerate("xyz"):
            shift = (1e3 * poses[:, place, 3]).tolist()
            yield HAND_EYE, "parameter", f"tool_from_camera, {axis}", "mm", shift
        for place, axis in enumerate("xyz"):
            yield HAND_EYE, "parameter", f"rotation vector, {axis}", "deg", turns[:, place].tolist()
    error, drawn = copy.deepcopy(model.error_model), []
    for own in fit.coefficients + given + thetas[:, model.num_geometry : model.num_columns]:
        error.set_coefficient_vector(own)
        drawn.append(error.paper_coefficients())
    for group, units in error.paper_values().items():
        for name in drawn[0].get(group, ()):
            yield group, "parameter", name, units[name][1], [one[group][name] for one in drawn]
    start = found.named.study.sums.layout.base
    for effect in found.effects:
        if isinstance(effect, MapEffect):
            size = float(effect.coefficients.square().mean().sqrt())
            yield effect.name, "effect", "a value for each pixel, RMS", "m", [size]
            continue
        terms = effect.terms(effect.shape)
        values = thetas[:, start : start + len(terms)] * effect.prior_sd()
        for term, own in zip(terms, values.T.tolist(), strict=True):
            yield effect.name, "effect", term.name, term.unit, own
        start += len(terms)
