"""What a corrector removes of the scene's light: what that takes, measured from a recording."""

import logging
import math

import numpy as np
import torch
from torch import Tensor

from tofcorr.correction.corrector import DepthCorrector
from tofcorr.correction.state import CalibrationState, SceneLight
from tofcorr.data.recording import valid_pixels
from tofcorr.errors import CalibrationDataError
from tofcorr.estimation.noise import fit_noise
from tofcorr.geometry.camera import CameraIntrinsics, DepthKind
from tofcorr.options import Options, PositiveNumber
from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.sample import thinned
from tofcorr.scene_light.bounces import (
    Frequencies,
    SecondBounces,
    SecondBouncesOptions,
    SecondBouncesState,
)
from tofcorr.scene_light.flying import (
    FlyingPixels,
    FlyingPixelsOptions,
    FlyingPixelsState,
    squared_spreads,
)
from tofcorr.scene_light.gain import fit_gain
from tofcorr.scene_light.stray import StrayLightState

_LOG = logging.getLogger(__name__)

_FRAMES = 24
"""Frames that are looked at, evenly spread. Chosen: each has thousands of pixels, and some hundred
at edges."""
_EDGES = 30
"""Fewest edges from which the point spread is known. Chosen: their median is then known to 5 %."""


class SecondBouncesWanted(SecondBouncesOptions):
    """What is to be removed.

    Attributes:
        frequencies_hz: Modulation frequencies; null: that of the recording.
        gain: One over pi times the amplitude of white paper at 1 m; null: found from the curvature
            that second bounces give to walls.
    """

    frequencies_hz: Frequencies | None = None
    gain: PositiveNumber | None = None


class RuntimeOptions(Options):
    """What the corrector does in a frame besides correcting every pixel; null: nothing.

    Attributes:
        stray_light: Take this stray light back, before the fit as well. `tofcorr train --with` has
            it from a diagnosis.
        flying_pixels: Find pixels that mix two surfaces.
        second_bounces: Remove light that comes by further surfaces.
    """

    second_bounces: SecondBouncesWanted | None = None
    stray_light: StrayLightState | None = None
    flying_pixels: FlyingPixelsOptions | None = None


def scene_light(data: Dataset, options: RuntimeOptions, state: CalibrationState) -> SceneLight:
    """Return what of the scene's light is to be removed, as recordings show it.

    Args:
        data: The recordings. All pixels are looked at, whether they see the target or not.
        options: What was asked for.
        state: The calibration of the camera.

    Raises:
        CalibrationDataError: Flying pixels are to be found, and there are no amplitudes.
    """
    wanted = options.flying_pixels
    flying = wanted and _flying_pixels(data, wanted, state)
    bounces = options.second_bounces and _second_bounces(data, options.second_bounces, state)
    return SceneLight(stray_light=options.stray_light, flying_pixels=flying, second_bounces=bounces)


def _second_bounces(
    data: Dataset, wanted: SecondBouncesWanted, state: CalibrationState
) -> SecondBouncesState:
    """Return what removing second bounces takes, with the gain found where none is given."""
    data.require("amplitude", "removing second bounces (runtime.second_bounces)")
    frequency, values = data.first.modulation_frequency, wanted.to_mapping()
    if wanted.frequencies_hz is None and frequency is None:
        said = "Second bounces need the modulation frequency, which the recording does not state"
        raise CalibrationDataError(f"{said}: set runtime.second_bounces.frequencies_hz.")
    values["frequencies_hz"] = wanted.frequencies_hz or (frequency,)
    if wanted.gain is not None:
        return SecondBouncesState.model_validate(values)
    depths, amplitudes = _corrected(data, state)
    radial = depths * DepthCorrector.from_state(state).radial_of_z
    frames = list(zip(radial, amplitudes, strict=True))
    # Half white, seen straight on, to begin with.
    bright = torch.cat([(d.square() * a).flatten() for d, a in frames]).nanmedian()
    values["gain"] = 1 / (2 * math.pi * float(bright))
    bounces = SecondBounces(state.camera, SecondBouncesState.model_validate(values))
    terms = state.correction().error_model.signal_terms

    def functions(distance: Tensor, amplitude: Tensor) -> Tensor:
        found = [distance[None], *(term.basis(distance, amplitude) for term in terms)]  # type: ignore[operator]
        return torch.cat(found)

    fit = fit_gain(bounces, frames, functions)
    values |= {"gain": fit.gain, "gain_interval": fit.interval}
    return SecondBouncesState.model_validate(values)


def _flying_pixels(
    data: Dataset, wanted: FlyingPixelsOptions, state: CalibrationState
) -> FlyingPixelsState | None:
    """Measure what finding flying pixels takes; None, and a warning, where there are none."""
    data.require("amplitude", "finding flying pixels (runtime.flying_pixels)")
    depths, amplitudes = _corrected(data, state)
    shown = shown_by(depths, amplitudes.float(), state.camera, state.depth_kind, wanted)
    if shown is None:
        _LOG.warning("Flying pixels are not looked for: the recording shows none.")
    return shown


def _corrected(data: Dataset, state: CalibrationState) -> tuple[Tensor, Tensor]:
    """Return depth, corrected, and amplitude of some frames (B, H, W); NaN where not usable."""
    corrector, frames = DepthCorrector.from_state(state), []
    for batch in data.batches(thinned(np.arange(data.num_frames), _FRAMES)):
        assert batch.amplitude is not None
        depth, amplitude = batch.radial_distance / corrector.radial_of_z, batch.amplitude
        usable = valid_pixels(depth, amplitude, None, state.saturation_amplitude)
        with torch.no_grad():
            corrected, _ = corrector(depth.float(), amplitude.float())
        frames.append((corrected.where(usable, torch.nan), amplitude.where(usable, torch.nan)))
    depths, amplitudes = (torch.cat(images) for images in zip(*frames, strict=True))
    return depths, amplitudes


@torch.no_grad()
def shown_by(
    depth: Tensor,
    amplitude: Tensor,
    camera: CameraIntrinsics,
    depth_kind: DepthKind,
    wanted: FlyingPixelsOptions,
) -> FlyingPixelsState | None:
    """Measure point spread and noise of frames; None if they have no edges, or no flying pixels.

    Args:
        depth: Of the camera's kind, corrected, shape (B, H, W), metres; NaN: not to be used.
        amplitude: The camera's units, the same shape; NaN: not to be used.
        camera: The lateral parameters.
        depth_kind: What depth means.
        wanted: What was asked for.
    """
    spreads = torch.cat([squared_spreads(one[None]) for one in amplitude])
    if len(spreads) < _EDGES:
        return None
    spread = float(spreads.median().clamp(min=0).sqrt())
    values = wanted.to_mapping() | {"point_spread_px": spread}
    finder = FlyingPixels(camera, depth_kind, FlyingPixelsState(**values, noise=(0.0, 0.0, 0.0)))
    # `fit_noise` takes differences of two pixels.
    off = torch.cat([finder.departures(one[None]) for one in depth]) * 2**0.5
    noise = fit_noise(off.flatten(), amplitude.flatten(), "neighbours")[:3]
    shown = FlyingPixelsState(**values, noise=noise)
    finder = FlyingPixels(camera, depth_kind, shown)
    flying = sum(int(finder.found(*one)[0].sum()) for one in zip(depth, amplitude, strict=True))
    return shown if flying > wanted.false_alarm * int(depth.isfinite().sum()) else None
