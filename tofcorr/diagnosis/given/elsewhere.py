"""A simulator that saw other poses: its error along every covariate, carried to the recording."""

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from tofcorr.diagnosis.given.coverage import amplitude_scale, beyond, worth_keeping
from tofcorr.diagnosis.given.error_model import fit_error
from tofcorr.diagnosis.given.simulator import Simulated
from tofcorr.diagnosis.given.true_depth import true_distance
from tofcorr.diagnosis.options import DiagnosisOptions
from tofcorr.diagnosis.sums.base_fit import fit_base
from tofcorr.diagnosis.sums.base_model import BaseModel
from tofcorr.diagnosis.sums.base_options import definite_base, supported_base
from tofcorr.diagnosis.sums.observations import Observations
from tofcorr.diagnosis.sums.prediction import effect_inputs, predicted_distance
from tofcorr.diagnosis.sums.simulator_error import SimulatorError
from tofcorr.simulation.effects import CATALOGUE, CatalogueEffect, MapEffect
from tofcorr.simulation.effects.inputs import EffectInputs

# The simulator's error is fitted to about this many of its pixels. Chosen: far more than it has
# coefficients, and some seconds of computing.
_MOST_PIXELS = 150_000
# Uncertain directions of the simulator's error that are kept: at most so many, and only those above
# this size in metres. Chosen: smaller ones change no finding.
_MOST_DIRECTIONS, _LEAST_DIRECTION = 24, 1e-5


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
    known = _truth(frames, pose)
    keep = known.error.isfinite()
    frames, known = frames.at(keep), known.at(keep)
    step = slice(None, None, max(1, len(frames.measured) // _MOST_PIXELS))
    frames, known = frames.at(step), known.at(step)
    there = effect_inputs(frames, pose)
    real, scale = _rescaled(real, frames, effect_inputs(real, pose), there)
    here = effect_inputs(real, pose)

    base, lacking = supported_base(frames.recording, options.base)
    base, _ = supported_base(real.recording, base)
    base, _ = definite_base(frames.recording, base)
    model = BaseModel(frames, base, hand_eye_free=False)
    effects, unknown = _effects_of_both(there, here)
    fitted = fit_error(frames, there, fit_base(model, frames, known), effects)

    error, uncertain = fitted.at(real, here)
    outside, warnings = _outside(real, frames, here, there)
    directions = worth_keeping(_principal(uncertain), _LEAST_DIRECTION, _MOST_DIRECTIONS)
    return Simulated(
        error=SimulatorError(
            error=torch.where(outside, torch.nan, error),
            sigma=torch.full_like(error, fitted.misfit),
            tool_from_camera=pose,
            uncertain=directions,
            carried=True,
        ),
        warnings=(
            f"The simulator saw other poses: its error was fitted to its own "
            f"{frames.num_frames} frames, to {1e3 * fitted.misfit:.1f} mm on held-out ones, and "
            "carried to the recording's pixels.",
            *_units(scale),
            *_limits(frames, lacking, unknown),
            *warnings,
        ),
    )


def _truth(frames: Observations, pose: Tensor) -> SimulatorError:
    """Return by how much the truth differs from the planes: nothing without a true depth."""
    apart = true_distance(frames) - predicted_distance(frames, pose)
    return SimulatorError(
        error=apart,
        sigma=torch.zeros_like(apart),
        tool_from_camera=pose,
        uncertain=apart.new_zeros(len(apart), 0),
    )


def _rescaled(
    real: Observations, frames: Observations, here: EffectInputs, there: EffectInputs
) -> tuple[Observations, float]:
    """Return the recording with amplitudes in the simulator's unit, and the ratio of the units."""
    if real.amplitude is None or real.amplitude_images is None:
        return real, 1.0
    shared = np.isin(real.recording.frames.target, frames.recording.frames.target)
    scale = amplitude_scale(here, torch.from_numpy(shared)[real.frame], there)
    changed = replace(
        real,
        amplitude=real.amplitude / scale,
        amplitude_images=real.amplitude_images / scale,
    )
    return changed, scale


def _units(scale: float) -> list[str]:
    if scale == 1.0:
        return []
    return [
        f"The recording's amplitudes are {scale:.3g} times the simulator's; they are taken to have "
        "another unit."
    ]


def _effects_of_both(
    there: EffectInputs, here: EffectInputs
) -> tuple[tuple[CatalogueEffect, ...], list[str]]:
    """Return the effects that both can show, and those that the simulator alone cannot."""
    effects, unknown = [], []
    for name, kind in CATALOGUE.items():
        if issubclass(kind, MapEffect) or kind.missing(here):
            continue
        if kind.missing(there):
            unknown.append(name)
        else:
            effects.append(kind.for_recording(there))
    return tuple(effects), unknown


def _limits(frames: Observations, lacking: list[str], unknown: list[str]) -> list[str]:
    """Say what the simulator's frames cannot tell, for want of data."""
    missing = [*dict.fromkeys([*lacking, *unknown])]
    if not missing:
        return []
    return [
        f"{frames.recording.path}: its frames lack the data of {', '.join(missing)}; whether "
        "the simulator has these already cannot be told."
    ]


def _outside(
    real: Observations, frames: Observations, here: EffectInputs, there: EffectInputs
) -> tuple[Tensor, list[str]]:
    """Return which pixels the simulator's frames do not cover, shape (M,), and warnings."""
    outside, warnings = beyond("distance in metres", here.radial_distance, there.radial_distance)
    if real.amplitude is not None and frames.amplitude is not None:
        dark, more = beyond("amplitude", real.amplitude, frames.amplitude)
        outside, warnings = outside | dark, [*warnings, *more]
    return outside, warnings


def _principal(columns: Tensor) -> Tensor:
    """Return the principal directions of columns (M, P) of independent coefficients, (M, P)."""
    _, turn = torch.linalg.eigh(columns.T @ columns)
    return columns @ turn
