"""The camera as a diagnosis found it: the content of `sensor.yaml`."""

import copy
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, cast
from warnings import catch_warnings, simplefilter

import numpy as np
import torch
from torch import Tensor

from tofcorr.data.recording import Recording, RigidTransform
from tofcorr.diagnosis.findings.naming import NamedEffects
from tofcorr.diagnosis.findings.shares import HAND_EYE
from tofcorr.diagnosis.findings.where import Estimated, Interval, interval_of
from tofcorr.diagnosis.rerun.checks import excess_gaps, fitted_to
from tofcorr.diagnosis.rerun.simulator import (
    NO_PATTERNS,
    Patterns,
    fitted_effects,
    observed_by,
    solution_of,
)
from tofcorr.diagnosis.sums.observations import Observations, distance_images, predicted_distance
from tofcorr.diagnosis.sums.study import Study
from tofcorr.geometry import se3
from tofcorr.geometry.rays import ray_directions
from tofcorr.observables.compare import Observables, compare_observables
from tofcorr.sensor.degrade import conditions_of_frames
from tofcorr.sensor.model import SensorModel, SensorWarning
from tofcorr.sensor.parts import section_of
from tofcorr.sensor.sensor_file import (
    ErrorSection,
    SensorFile,
    dropout_section,
    light_section,
    validity_of,
)
from tofcorr.simulation.effects import CatalogueEffect, MapEffect
from tofcorr.simulation.effects.inputs import EffectInputs
from tofcorr.simulation.effects.registry import build_effects
from tofcorr.simulation.effects.saturation import light_of
from tofcorr.simulation.options import CameraOptions, SimulatorOptions


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
    model = study.fit.model
    terms, error_model = model.options.with_columns().terms, copy.deepcopy(model.error_model)
    error_model.set_coefficient_vector(fitted + error)
    sentences = [
        f"{study.observations.num_units} poses, {recording.num_frames} frames.",
        *([] if named.names else ["No effect beyond the error terms was found."]),
    ]
    if remainder > 1e-4:  # A tenth of the least gap that matters.
        sentences.append(
            f"The simulator under diagnosis makes an error of {1e3 * remainder:.1f} mm RMS that no "
            "term or effect of this file holds."
        )
    return SensorFile(
        format="tofcorr-sensor",
        version=1,
        title="A time-of-flight camera, as a diagnosis found it.",
        measured_from=tuple(sentences),
        camera=CameraOptions.of(recording.camera),
        depth_kind=recording.depth_kind,
        modulation_frequency_hz=recording.modulation_frequency,
        tool_from_camera=cast(RigidTransform, tuple(map(tuple, pose.tolist()))),
        error=section_of(error_model, ErrorSection(reads="true_distance", terms=terms)),
        effects=(*given, *entries),
        **({} if observables is None else _sections(study, observables, own)),
        validity=validity_of(model.domain),
    )


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


def expected_images(
    model: SensorModel,
    recording: Recording,
    frames: Tensor,
    distance: Tensor,
    amplitude: Tensor | None,
) -> Tensor:
    """Return the expected radial distances of F frames, shape (F, H, W), metres.

    Args:
        model: The sensor.
        recording: Conditions of all frames: effects of whole frames depend on those before.
        frames: Numbers of the F frames, int64.
        distance: True distances along the rays, shape (F, H, W), metres.
        amplitude: Light that returns, shape (F, H, W), counts; None: unknown.
    """
    shift = model.frame_shift(recording.num_frames, **conditions_of_frames(recording))
    slant = ray_directions(recording.camera)[..., 2]
    scale = slant if model.sensor.depth_kind == "z" else torch.ones_like(slant)
    measured = torch.empty_like(distance, dtype=torch.float64)
    with torch.inference_mode():
        for place, number in enumerate(frames.tolist()):
            found = model(
                distance[place].double() * scale,
                None if amplitude is None else amplitude[place].double(),
                noise=False,
                frame_shift=shift[number],
                **conditions_of_frames(recording, number),
            )
            measured[place] = found.depth / scale
    return measured


def light_images(
    model: SensorModel, observations: Observations, inputs: EffectInputs
) -> Tensor | None:
    """Return the light that reached the camera, shape (F, H, W), counts; None: not recorded.

    It is the recorded amplitude. Where a sensor clips bright pixels, that of the chosen pixels is
    what it would have been without clipping, as in the fit.
    """
    images = observations.amplitude_images
    if images is None or not model.effects.reads_light:
        return images
    lit = images.double().flatten(1)
    lit[observations.frame, observations.pixel] = light_of(inputs)
    return lit.reshape(images.shape)


# Pixels that are degraded at most; of larger recordings evenly chosen poses. Chosen: 32 VGA frames,
# some seconds.
_MOST_PIXELS = 10_000_000


@dataclass(frozen=True, kw_only=True)
class DegradedStage:
    """Ideal frames through the sensor that was found, against real frames of other poses.

    Attributes:
        gap: Root mean square in excess of the noise, metres; its interval has poses as the unit,
            and the fit is not repeated.
        poses: How many poses were compared.
        left_out: Effects of the sensor that no depth image can show, and why, a sentence each.
    """

    gap: Estimated
    poses: int
    left_out: tuple[str, ...]


def degraded_stage(
    study: Study,
    named: NamedEffects,
    simulator: SimulatorOptions | None,
    floor: float,
    resamples: Tensor,
) -> DegradedStage:
    """Fit the sensor without each fold of the poses, and degrade ideal frames of that fold.

    The effects were chosen with all poses; hand-eye transform and coefficients are those of the
    other folds. Ideal frames show the target's plane, and off the target what was measured.

    Args:
        study: The recording, before any effect was named.
        named: The effects named.
        simulator: The built-in simulator with them; None where another one rendered frames.
        floor: Noise of a pixel, root mean square, metres, as in the other stages.
        resamples: How often each resample holds each pose, shape (B, U).
    """
    observations = study.observations
    frames = max(_MOST_PIXELS // observations.distance_images[0].numel(), 1)
    units = observations.num_units
    count = int(np.clip(units * frames / observations.num_frames, 1, units))
    chosen = torch.linspace(0, units - 1, count).round().long()
    among = torch.zeros(units, dtype=torch.bool)
    among[chosen] = True
    expected = torch.full_like(observations.measured, torch.nan)
    left_out: tuple[str, ...] = ()
    for held in ((members > 0) & among for members in study.folds):
        if not bool(held.any()):
            continue
        own = fitted_to(study, ~held, named.columns)
        model_named = replace(named, study=fitted_to(named.study, ~held, named.columns))
        with catch_warnings():
            simplefilter("ignore", SensorWarning)  # `left_out` says so once, and not in each fold.
            model = SensorModel(sensor_of(own, model_named, simulator, None), torch.float64)
            left_out = model.left_out
            frames_held = torch.nonzero(held[observations.unit]).reshape(-1)
            seen, light = (
                observed_by(own, model_named),
                light_images(model, observations, own.inputs),
            )
            ideal = distance_images(seen, solution_of(own, model_named)[0], frames_held)
            lit = None if light is None else light[frames_held]
            images = expected_images(model, seen.recording, frames_held, ideal, lit).flatten(1)
        pixels = held[study.unit_of_pixel].nonzero().reshape(-1)
        place = torch.searchsorted(frames_held, observations.frame[pixels])
        expected[pixels] = images[place, observations.pixel[pixels]]
    left = observations.measured - expected
    gap, *draws = excess_gaps(observations, left, study.fit.share, floor, resamples).tolist()
    return DegradedStage(gap=Estimated(gap, draws), poses=len(chosen), left_out=left_out)


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


def fitted_values(
    study: Study, named: NamedEffects, given_effects: Sequence[Mapping[str, Any]], resamples: Tensor
) -> tuple[FittedValue, ...]:
    """Return hand-eye transform, coefficients of the base terms, and those of the named effects.

    Args:
        study: The recording, before any effect was named.
        named: The effects named.
        given_effects: Those of the built-in simulator under diagnosis; empty where there is none.
        resamples: How often each resample holds each pose, shape (B, U).
    """
    sums = named.study.sums.ols
    gram, score, prior = sums.of(named.columns)
    normal = torch.tensordot(resamples, gram, dims=1) + prior
    draws = torch.linalg.solve(normal, (resamples @ score)[..., None])[..., 0]
    thetas = torch.cat([sums.solve(named.columns)[None], draws])
    given, found = given_error(study, given_effects)[0], []
    for cause, kind, name, unit, (value, *drawn) in _parameters(study, named, thetas, given):
        known = bool(drawn) and all(map(math.isfinite, (value, *drawn)))
        interval = interval_of(drawn, value) if known else None
        found.append(FittedValue(cause, kind, name, unit, value, interval))
    return tuple(found)


def _parameters(
    study: Study, named: NamedEffects, thetas: Tensor, given: Tensor
) -> Iterator[tuple[str, str, str, str, list[float]]]:
    """Yield cause, kind, name and unit of each parameter, its estimate, and those of resamples.

    Args:
        study: The recording, before any effect was named.
        named: The effects named.
        thetas: The estimate of all columns and those of the resamples, shape (1 + B, K).
        given: A given simulator's own error as coefficients of the base terms.
    """
    model, fit = study.fit.model, study.fit
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
    for group, units in error.paper_units().items():
        for name in drawn[0].get(group, ()):
            yield group, "parameter", name, units[name], [one[group][name] for one in drawn]
    start = named.study.sums.layout.base
    for effect in fitted_effects(study, named):
        if isinstance(effect, MapEffect):
            size = float(effect.coefficients.square().mean().sqrt())
            yield effect.name, "effect", "a value for each pixel, RMS", "m", [size]
            continue
        terms = effect.terms(effect.shape)
        values = thetas[:, start : start + len(terms)] * effect.prior_sd()
        for term, own in zip(terms, values.T.tolist(), strict=True):
            yield effect.name, "effect", term.name, term.unit, own
        start += len(terms)
