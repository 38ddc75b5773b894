"""A simulator that saw other poses: its error along every covariate, carried to the recording.

The truth of a simulator is known, so that its error is known in every pixel of every frame. Base
terms, effects of the catalogue, and one value a pixel are fitted to it together, each with its
prior. Effects are added as long as the Bayesian information criterion falls. Nothing is named: what
matters is the sum at other covariates.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from tofcorr.data.arrays import open_array, read_frames
from tofcorr.data.recording import Recording
from tofcorr.diagnosis.given.simulator import Simulated
from tofcorr.diagnosis.options import DiagnosisOptions
from tofcorr.diagnosis.sums.base_fit import BaseFit, SimulatorError, fit_base
from tofcorr.diagnosis.sums.base_model import BaseModel, definite_base, supported_base
from tofcorr.diagnosis.sums.linear_system import BASE, PoseSums, pose_columns, pose_sums
from tofcorr.diagnosis.sums.observations import (
    TINY,
    Observations,
    effect_inputs,
    predicted_distance,
)
from tofcorr.errors import CalibrationDataError
from tofcorr.geometry.rays import ray_directions
from tofcorr.simulation.effects import CATALOGUE, CatalogueEffect, MapEffect
from tofcorr.simulation.effects.inputs import EffectInputs

# Share of a variable's values that its range leaves out at each end, against single gross errors;
# and shares of pixels beyond a range up to this are not worth a warning. Chosen.
_OUTSIDE = 0.001
# A range counts as covered this far beyond its ends, as a share of it. Chosen: a low polynomial
# hardly leaves its course there.
_MARGIN = 0.05
# Amplitudes whose scales differ by less than this factor have the same unit. Chosen: the median of
# other poses and of targets of several brightnesses varies almost so much.
_SAME_UNIT = 1.5
# The simulator's error is fitted to about this many of its pixels. Chosen: far more than it has
# coefficients, and some seconds of computing.
_MOST_PIXELS = 150_000
# Linearisations of effects that are not linear; the third changes nothing any more. Effects larger
# than the second number, metres, are linearised again; uncertain directions of the simulator's
# error smaller than it are left out, and those beyond the largest so many. Chosen: smaller ones
# change no finding.
_LINEARISATIONS, _SMALL, _MOST_DIRECTIONS = 2, 1e-5, 24
_FILE = "true_depth.npy"


def has_true_depth(recording: Recording) -> bool:
    """Return whether the recording holds the true depth."""
    return (recording.path / _FILE).exists()


def true_distance(frames: Observations) -> Tensor:
    """Return the true radial distance of the chosen pixels, shape (M,), metres.

    It is that of `true_depth.npy`, NaN where the file has none; without the file, that of the
    planes.

    Raises:
        CalibrationDataError: The file does not fit the recording.
    """
    recording = frames.recording
    if not has_true_depth(recording):
        return predicted_distance(frames, torch.from_numpy(recording.tool_from_camera))
    path = recording.path / _FILE
    array = open_array(path, np.float32, (recording.camera.height, recording.camera.width))
    if len(array) != recording.num_frames:
        raise CalibrationDataError(
            f"{path}: has {len(array)} frames; frames.csv has {recording.num_frames} rows."
        )
    depth = torch.full_like(frames.measured, torch.nan)
    for frame, (start, end) in enumerate(frames.frame_ends):
        image = torch.from_numpy(read_frames(array, np.array([frame]))[0]).double().reshape(-1)
        depth[start:end] = image[frames.pixel[start:end]]
    depth = torch.where(depth > 0, depth, torch.nan)
    if recording.depth_kind == "radial":
        return depth
    rays = ray_directions(recording.camera).reshape(-1, 3)[frames.pixel]
    return depth / rays[:, 2]


def simulated_elsewhere(
    frames: Observations, real: Observations, options: DiagnosisOptions
) -> Simulated:
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
    keep = keep[:: max(1, len(keep) // _MOST_PIXELS)]
    frames, known = frames.at(keep), known.at(keep)
    there = effect_inputs(frames, pose)
    scale = _amplitude_scale(real, frames, effect_inputs(real, pose), there)
    if real.amplitude is not None and real.amplitude_images is not None:
        images = real.amplitude_images / scale
        real = replace(real, amplitude=real.amplitude / scale, amplitude_images=images)
    here = effect_inputs(real, pose)
    base, lacking = supported_base(frames.recording, options.base)
    base, _ = supported_base(real.recording, base)
    base, _ = definite_base(frames.recording, base)
    model = BaseModel(frames, base, hand_eye_free=False)
    kinds = {
        n: k for n, k in CATALOGUE.items() if not (issubclass(k, MapEffect) or k.missing(here))
    }
    lacking += [name for name, kind in kinds.items() if kind.missing(there)]
    effects = [k.for_recording(there) for k in kinds.values() if not k.missing(there)]
    fitted = fit_error(frames, there, fit_base(model, frames, known), effects)
    error, uncertain = fitted.at(real, here)
    outside, warnings = torch.zeros_like(error, dtype=torch.bool), []
    ranges = {"distance in metres": (here.radial_distance, there.radial_distance)}
    if real.amplitude is not None and frames.amplitude is not None:
        ranges["amplitude"] = real.amplitude, frames.amplitude
    for name, values in ranges.items():
        beyond, words = _beyond(name, *values)
        outside, warnings = outside | beyond, [*warnings, *words]
    return Simulated(
        SimulatorError(
            error=torch.where(outside, torch.nan, error),
            sigma=torch.full_like(error, fitted.misfit),
            tool_from_camera=pose,
            uncertain=_principal(uncertain),
            carried=True,
        ),
        (
            f"The simulator saw other poses: its error was fitted to its own "
            f"{frames.num_frames} frames, to {1000 * fitted.misfit:.1f} mm on held-out ones, and "
            "carried to the recording's pixels.",
            *_limits(frames, scale, lacking),
            *warnings,
        ),
    )


def _amplitude_scale(
    real: Observations, frames: Observations, here: EffectInputs, there: EffectInputs
) -> float:
    """Return the recording's unit of amplitude over the simulator's; 1 if they are alike.

    An amplitude falls with the square of the distance and the cosine of the incidence, and grows
    with the integration time; what remains is compared by its median over like targets.
    """
    shared = np.isin(real.recording.frames.target, frames.recording.frames.target)
    targets = torch.from_numpy(shared)[real.frame]
    if here.amplitude is None or there.amplitude is None or not bool(targets.any()):
        return 1.0
    times = here.facts.integration_time, there.facts.integration_time
    timed = None not in times

    def brightness(inputs: EffectInputs, time: Tensor | None) -> Tensor:
        cosine = inputs.incidence_cosine.clamp(min=1 / 1000)
        own = inputs.known_amplitude * inputs.radial_distance**2 / cosine
        return own / inputs.of_frame(time) if timed and time is not None else own

    own = brightness(here, times[0])[targets].median()
    ratio = float(own / brightness(there, times[1]).median())
    return ratio if ratio > _SAME_UNIT or 0 < ratio < 1 / _SAME_UNIT else 1.0


def _beyond(name: str, real: Tensor, simulated: Tensor) -> tuple[Tensor, list[str]]:
    """Return which pixels lie beyond the simulator's range of a variable, and a warning.

    Args:
        name: Of the variable, for the warning.
        real: Values of the recording, shape (M,).
        simulated: Values of the simulator's frames.
    """
    ordered = simulated.sort().values
    low, high = (float(ordered[round(q * (len(ordered) - 1))]) for q in (_OUTSIDE, 1 - _OUTSIDE))
    margin = _MARGIN * (high - low)
    outside = (real < low - margin) | (real > high + margin)
    share = float(outside.double().mean())
    if share <= _OUTSIDE:
        return outside, []
    return outside, [
        f"{100 * share:.1f} % of the recording's pixels lie beyond the simulator's range of "
        f"{name} ({low:.3g} to {high:.3g}); they are left out."
    ]


def _limits(frames: Observations, scale: float, missing: Sequence[str]) -> list[str]:
    """Say what limits the comparison: another unit, and what the frames lack data for."""
    found = []
    if scale != 1.0:
        found.append(
            f"The recording's amplitudes are {scale:.3g} times the simulator's; they are taken to "
            "have another unit."
        )
    if missing:
        found.append(
            f"{frames.recording.path}: its frames lack the data of "
            f"{', '.join(dict.fromkeys(missing))}; whether the simulator has these already cannot "
            "be told."
        )
    return found


def _principal(columns: Tensor) -> Tensor:
    """Return the largest principal directions of columns (M, P) of independent coefficients."""
    directions = columns @ torch.linalg.eigh(columns.T @ columns)[1]
    size = directions.square().mean(0).sqrt()
    order = size.argsort(descending=True)[:_MOST_DIRECTIONS]
    return directions[:, order[size[order] > _SMALL]]


@dataclass(frozen=True, kw_only=True)
class ErrorOfSimulator:
    """A fitted error of a simulator.

    Attributes:
        fit: The base model, fitted to the simulator's frames.
        effects: The effects fitted, with their coefficients.
        change: Of the base model's coefficients, shape (K,).
        covariance: Of base coefficients and scaled effect coefficients, shape (P, P).
        pattern: One value a pixel; None where the frames do not show it.
        misfit: Root mean square error on held-out poses in excess of noise, metres.
    """

    fit: BaseFit
    effects: list[CatalogueEffect]
    change: Tensor
    covariance: Tensor
    pattern: MapEffect | None
    misfit: float

    def at(self, pixels: Observations, inputs: EffectInputs) -> tuple[Tensor, Tensor]:
        """Return the error of other pixels (M,), and columns (M, P) of what is uncertain, metres.

        Args:
            pixels: Of any recording of the same camera.
            inputs: What effects may depend on there, with the simulator's hand-eye transform.
        """
        columns = self.fit.model.on(pixels).error_columns(inputs.radial_distance)
        error = columns @ (self.fit.coefficients + self.change)
        parts = [columns]
        for effect in self.effects:
            error = error + effect.shift(inputs, effect.coefficients)
            parts.append(effect.slope(inputs, effect.coefficients) * effect.prior_sd())
        if self.pattern is not None:
            error = error + self.pattern.shift(inputs, self.pattern.coefficients)
        # The matrix is singular to rounding where the frames determine a coefficient very well.
        variance, turn = torch.linalg.eigh(self.covariance)
        return error, torch.cat(parts, dim=1) @ (turn * variance.clamp(min=0.0).sqrt())


def fit_error(
    frames: Observations,
    inputs: EffectInputs,
    fit: BaseFit,
    effects: list[CatalogueEffect],
) -> ErrorOfSimulator:
    """Fit base terms and effects together to a simulator's frames.

    Args:
        frames: Its pixels.
        inputs: What effects may depend on there.
        fit: The base model, fitted to them with the exact hand-eye transform.
        effects: Which effects, with coefficients of zero.
    """
    base = fit.model.columns(fit.tool_from_camera)
    count = base.shape[1]
    fitted = _needed(_sums(frames, inputs, fit, effects), effects, len(frames.measured))
    names = [effect.name for effect in fitted]
    sums, theta = None, None
    for _ in range(1 + _LINEARISATIONS):
        sums = _sums(frames, inputs, fit, fitted).with_pose_uncertainty(names)
        theta = sums.gls.solve(names)
        fitted = _by_effect(fitted, theta[count:])
        bent = [each.shift(inputs, each.coefficients) for each in fitted if not each.linear]
        if not any(float(shift.square().mean().sqrt()) > _SMALL for shift in bent):
            break
    assert sums is not None
    assert theta is not None
    residual = fit.residual - base @ theta[:count]
    for effect in fitted:
        residual = residual - effect.shift(inputs, effect.coefficients)
    pattern, fixed = _pattern(frames, inputs, residual, fit)
    left = float(sums.ols.left_out_squares(names).sum() / sums.count.sum())
    return ErrorOfSimulator(
        fit=fit,
        effects=fitted,
        change=theta[:count],
        covariance=torch.linalg.inv(sums.gls.normal(names)),
        pattern=pattern,
        misfit=max(left - fit.floor**2 - fixed, 0.0) ** 0.5,
    )


def _sums(
    frames: Observations, inputs: EffectInputs, fit: BaseFit, effects: Sequence[CatalogueEffect]
) -> PoseSums:
    """Return the sums of base terms and effects, linearised where they are."""
    residual, columns = fit.residual, {BASE: fit.model.columns(fit.tool_from_camera)}
    for effect in effects:
        slope = effect.slope(inputs, effect.coefficients)
        shift = effect.shift(inputs, effect.coefficients)
        residual = residual - (shift - slope @ effect.coefficients)
        columns[effect.name] = slope * effect.prior_sd()
    prior = fit.model.prior_precision()
    return pose_sums(frames, columns, pose_columns(inputs), residual, fit, prior)


def _needed(
    sums: PoseSums, effects: Sequence[CatalogueEffect], pixels: int
) -> list[CatalogueEffect]:
    """Return the effects that lower the Bayesian information criterion.

    Args:
        sums: Of base terms and all effects.
        effects: The effects.
        pixels: Number of pixels; an effect must lower chi-squared by its logarithm a coefficient.
    """
    sums, chosen = sums.with_pose_uncertainty(), list[str]()

    def explained(names: Sequence[str]) -> float:
        """Return by how much base terms and effects lower chi-squared."""
        return float(sums.gls.solve(names) @ sums.gls.of(names)[1].sum(0))

    while len(chosen) < len(effects):
        now = explained(chosen)
        gains = {
            each.name: explained([*chosen, each.name])
            - now
            - len(each.coefficients) * math.log(pixels)
            for each in effects
            if each.name not in chosen
        }
        best = max(gains, key=lambda name: gains[name])
        if gains[best] <= 0:
            break
        chosen.append(best)
        sums = sums.with_pose_uncertainty(chosen)
    return [each for each in effects if each.name in chosen]


def _by_effect(effects: Sequence[CatalogueEffect], theta: Tensor) -> list[CatalogueEffect]:
    """Return the effects with the coefficients of a solution, in their own units."""
    parts = theta.split([len(effect.coefficients) for effect in effects])
    return [
        effect.with_coefficients(own * effect.prior_sd())
        for effect, own in zip(effects, parts, strict=True)
    ]


def _pattern(
    frames: Observations, inputs: EffectInputs, residual: Tensor, fit: BaseFit
) -> tuple[MapEffect | None, float]:
    """Return what all frames share in a pixel, shrunk by its noise, and its mean square, m^2."""
    kinds = [kind for kind in CATALOGUE.values() if issubclass(kind, MapEffect)]
    kind = max(kinds, key=lambda each: len(each.contains))
    effect = kind.for_recording(inputs)
    cells, count = effect.cells_of(inputs)[:, 0], effect.num_cells(effect.shape)
    weight = fit.trust / fit.sigma**2
    zeros = torch.zeros(count, dtype=torch.float64)
    total = zeros.index_add(0, cells, weight).clamp(min=TINY)
    mean = zeros.index_add(0, cells, weight * residual) / total
    # Products of different frames hold what they share, without the noise of each.
    pairs = total**2 - zeros.index_add(0, cells, weight**2)
    products = (mean * total) ** 2 - zeros.index_add(0, cells, (weight * residual) ** 2)
    shared = max(float(products.sum() / pairs.sum().clamp(min=TINY)), 0.0)
    if shared == 0:
        return None, 0.0
    return effect.with_coefficients(mean * shared / (shared + 1 / total)), shared
