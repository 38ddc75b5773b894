"""A simulator that saw other poses: its error along every covariate, carried to the recording.

The truth of a simulator is known, so that its error is known in every pixel of every frame. Base
terms, effects of the catalogue, and one value a pixel are fitted to it together, each with its
prior. Effects are added as long as the Bayesian information criterion falls. Nothing is named: what
matters is the sum at other covariates.
"""

import math
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from tofcorr.diagnosis.options import DiagnosisOptions
from tofcorr.diagnosis.sums.base import (
    BaseModel,
    SimulatorError,
    definite_base,
    fit_base,
    supported_base,
)
from tofcorr.diagnosis.sums.linearised import in_best_forms, relinearised
from tofcorr.diagnosis.sums.observations import (
    TINY,
    Observations,
    effect_inputs,
    predicted_distance,
)
from tofcorr.diagnosis.sums.study import (
    FittedMap,
    Study,
    build_study,
    with_poses_reestimated,
)
from tofcorr.simulation.effects import CATALOGUE, MapEffect
from tofcorr.simulation.effects.base import EffectInputs


def true_distance(frames: Observations) -> Tensor:
    """Return the true radial distance of the chosen pixels, shape (M,), metres.

    It is that of `true_depth.npy`, NaN where the file has none; without the file, that of the
    planes.
    """
    recording = frames.recording
    if recording.true_depth is None:
        return predicted_distance(frames, torch.from_numpy(recording.tool_from_camera))
    images = recording.read("true_depth", np.arange(recording.num_frames))
    depth = torch.from_numpy(images).flatten(1)[frames.frame, frames.pixel].double()
    depth = torch.where(depth > 0, depth, torch.nan)
    return depth if recording.depth_kind == "radial" else depth / frames.rays[:, 2]


def simulated_elsewhere(
    frames: Observations, real: Observations, options: DiagnosisOptions
) -> SimulatorError:
    """Fit the simulator's error to its own frames, and predict it for a recording's pixels.

    Args:
        frames: The pixels that the simulator rendered.
        real: Those of the recording.
        options: Of the diagnosis; its base model is that of the simulator as well.
    """
    pose = torch.from_numpy(frames.recording.tool_from_camera)
    # The truth differs from the planes by nothing without a true depth.
    known = SimulatorError.exact(true_distance(frames) - predicted_distance(frames, pose), pose)
    keep = known.error.isfinite().nonzero()[:, 0]
    # Far more pixels than coefficients, and some seconds of computing.
    keep = keep[:: max(1, len(keep) // 150_000)]
    frames, known = frames.at(keep), known.at(keep)
    here, there = effect_inputs(real, pose), effect_inputs(frames, pose)
    scale = _amplitude_scale(real, frames, here, there)
    if real.amplitude is not None:
        scaled = {name: getattr(real, name) / scale for name in ("amplitude", "amplitude_images")}
        real, here = replace(real, **scaled), replace(here, **scaled)
    base, lacking = supported_base(frames.recording, options.base)
    base, _ = supported_base(real.recording, base)
    base, _ = definite_base(frames.recording, base)
    fit = fit_base(BaseModel(frames, base, hand_eye_free=False), frames, known)
    kinds = {n: kind for n, kind in CATALOGUE.items() if not kind.missing(here)}
    lacking += [n for n, k in kinds.items() if k.missing(there) and not issubclass(k, MapEffect)]
    every = options.model_copy(update={"catalogue": tuple(kinds), "leave_out": ()})
    study = in_best_forms(build_study(every, frames, fit, there))
    error, uncertain, misfit = _carried(study, real, here)
    outside, warnings = torch.zeros_like(error, dtype=torch.bool), []
    if scale != 1.0:
        warnings.append(
            f"The recording's amplitudes are {scale:.3g} times the simulator's; they are taken to "
            "have another unit."
        )
    if lacking:
        warnings.append(
            f"{frames.recording.path}: its frames lack the data of "
            f"{', '.join(dict.fromkeys(lacking))}; whether the simulator has these already cannot "
            "be told."
        )
    seen = fit.model.domain
    ranges = (here.radial_distance, seen.radial_distance), (real.amplitude, seen.amplitude)
    for values, interval in ranges:
        if values is not None and interval is not None:
            # A low polynomial hardly leaves its course within a twentieth beyond its range.
            reach = (interval.high - interval.low) / 20
            outside |= (values < interval.low - reach) | (values > interval.high + reach)
    share = float(outside.double().mean())
    if 1000 * share > 1:
        warnings.append(
            f"{100 * share:.1f} % of the recording's pixels lie beyond the simulator's distances "
            "or amplitudes; they are left out."
        )
    first = (
        f"The simulator saw other poses: its error was fitted to its own {frames.num_frames} "
        f"frames, to {1000 * misfit:.1f} mm on held-out ones, and carried to the recording's "
        "pixels."
    )
    return SimulatorError(
        error=torch.where(outside, torch.nan, error),
        sigma=torch.full_like(error, misfit),
        tool_from_camera=pose,
        uncertain=uncertain,
        carried=True,
        limits=(first, *warnings),
    )


def _amplitude_scale(
    real: Observations, frames: Observations, here: EffectInputs, there: EffectInputs
) -> float:
    """Return the recording's unit of amplitude over the simulator's; 1 if they are alike.

    An amplitude falls with the square of the distance and the cosine of the incidence, and grows
    with the integration time; what remains is compared by its median over like targets. The median
    of other poses and of targets of several brightnesses varies almost by half.
    """
    shared = np.isin(real.recording.frames.target, frames.recording.frames.target)
    targets = torch.from_numpy(shared)[real.frame]
    if here.amplitude is None or there.amplitude is None or not bool(targets.any()):
        return 1.0
    times = here.facts.integration_time, there.facts.integration_time

    def brightness(inputs: EffectInputs, time: Tensor | None) -> Tensor:
        cosine = inputs.incidence_cosine.clamp(min=1 / 1000)
        own = inputs.known_amplitude * inputs.radial_distance**2 / cosine
        return own if time is None or None in times else own / inputs.of_frame(time)

    own = brightness(here, times[0])[targets].median()
    ratio = float(own / brightness(there, times[1]).median())
    return ratio if max(ratio, 1 / max(ratio, TINY)) > 1.5 else 1.0


def _carried(study: Study, real: Observations, here: EffectInputs) -> tuple[Tensor, Tensor, float]:
    """Fit base terms and effects to a simulator's frames; predict them at other pixels.

    Args:
        study: The frames, with the exact hand-eye transform.
        real: The pixels of the recording.
        here: What effects may depend on there, with the simulator's hand-eye transform.

    Returns:
        The error there, (M,), metres; columns of what is uncertain of it, (M, J), metres; and the
        root mean square error on held-out poses in excess of noise, metres.
    """
    names = _needed(study)
    study = relinearised(with_poses_reestimated(study, names), names)
    gls, fit = study.sums.gls, study.fit
    theta, covariance = gls.solve(names), torch.linalg.inv(gls.normal(names))
    columns = [fit.model.on(real).error_columns(here.radial_distance)]
    # What stands in for an amplitude that was not recorded is not carried on.
    count, base = columns[0].shape[1], gls.layout.base
    carried = torch.cat([torch.arange(count), torch.arange(base, len(theta))])
    error = columns[0] @ (fit.coefficients + theta[:count])
    effects = [study.effects[name] for name in names]
    parts = theta[base:].split([len(effect.coefficients) for effect in effects])
    for effect, part in zip(effects, parts, strict=True):
        own = part * effect.prior_sd()
        error = error + effect.shift(here, own)
        columns.append(effect.slope(here, own) * effect.prior_sd())
    kinds = [kind for kind in CATALOGUE.values() if issubclass(kind, MapEffect)]
    pattern = max(kinds, key=lambda kind: len(kind.contains)).for_recording(study.inputs)
    fixed = FittedMap(study, pattern, study.residual_of(names, gls=True), least_sd=TINY)
    error = error + pattern.shift(here, fixed.whole())
    left = study.left_out_mean_square(names) - fit.floor**2 - fixed.prior_sd**2
    # The matrix is singular to rounding where the frames determine a coefficient very well.
    variance, turn = torch.linalg.eigh(covariance[carried][:, carried])
    uncertain = torch.cat(columns, dim=1) @ (turn * variance.clamp(min=0.0).sqrt())
    # Beyond the largest two dozen directions none changes a finding; they come last.
    largest = torch.linalg.eigh(uncertain.T @ uncertain).eigenvectors[:, -24:]
    return error, uncertain @ largest, max(left, 0.0) ** 0.5


def _needed(study: Study) -> list[str]:
    """Return the effects that lower the Bayesian information criterion.

    An effect must lower chi-squared by the logarithm of the number of pixels a coefficient.
    """
    effects, chosen = study.effects, list[str]()
    price = math.log(len(study.observations.measured))

    def explained(names: list[str]) -> float:
        """Return by how much base terms and effects lower the criterion."""
        gls = study.sums.gls
        fall = float(gls.solve(names) @ gls.score[:, gls.layout.of(names)].sum(0))
        return fall - price * sum(len(effects[name].coefficients) for name in names)

    while len(chosen) < len(effects):
        now = explained(chosen)
        gains = {n: explained([*chosen, n]) - now for n in effects if n not in chosen}
        best = max(gains, key=lambda name: gains[name])
        if gains[best] <= 0:
            break
        chosen.append(best)
        study = with_poses_reestimated(study, chosen)
    return chosen
