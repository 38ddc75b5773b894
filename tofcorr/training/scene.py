"""What a corrector removes of the scene's light: what that takes, measured from a recording."""

import logging

import numpy as np
import torch

from tofcorr.correction.corrector import DepthCorrector
from tofcorr.correction.state import CalibrationState, SceneLight
from tofcorr.data.recording import valid_pixels
from tofcorr.estimation.noise import fit_noise
from tofcorr.options import Options
from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.sample import thinned
from tofcorr.scene_light.flying import (
    FlyingPixels,
    FlyingPixelsOptions,
    FlyingPixelsState,
    squared_spreads,
)
from tofcorr.scene_light.stray import StrayLightState

_LOG = logging.getLogger(__name__)

_FRAMES = 24
"""Frames that are looked at, evenly spread. Chosen: each has thousands of pixels, and some hundred
at edges."""
_EDGES = 30
"""Fewest edges from which the point spread is known. Chosen: their median is then known to 5 %."""


class RuntimeOptions(Options):
    """What the corrector does in a frame besides correcting every pixel; null: nothing.

    Attributes:
        stray_light: Take this stray light back, before the fit as well. `tofcorr train --with` has
            it from a diagnosis.
        flying_pixels: Find pixels that mix two surfaces.
    """

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
    return SceneLight(stray_light=options.stray_light, flying_pixels=flying)


@torch.no_grad()
def _flying_pixels(
    data: Dataset, wanted: FlyingPixelsOptions, state: CalibrationState
) -> FlyingPixelsState | None:
    """Measure point spread and noise; None, and a warning, where the recordings show none."""
    data.require("amplitude", "finding flying pixels (runtime.flying_pixels)")
    corrector, frames, spreads = DepthCorrector.from_state(state), [], []
    for batch in data.batches(thinned(np.arange(data.num_frames), _FRAMES)):
        assert batch.amplitude is not None
        depth, amplitude = (batch.radial_distance / corrector.radial_of_z).float(), batch.amplitude
        usable = valid_pixels(depth, amplitude, None, state.saturation_amplitude)
        spreads.append(squared_spreads(amplitude, usable))
        amplitude = amplitude.float()
        frames.append((corrector(depth, amplitude)[0].where(usable, torch.nan), amplitude))
    found = torch.cat(spreads)
    if len(found) < _EDGES:
        _LOG.warning("Flying pixels are not looked for: the recording shows no edge of brightness.")
        return None
    shown = FlyingPixelsState(
        false_alarm=wanted.false_alarm,
        point_spread_px=float(found.median().clamp(min=1 / 12).sqrt()),
        noise=(0.0, 0.0, 0.0),
    )
    depths, amplitudes = (torch.cat(images) for images in zip(*frames, strict=True))
    finder = FlyingPixels(state.camera, state.depth_kind, shown)
    departures = finder.departures(depths)
    noise = fit_noise(2**0.5 * departures.flatten(), amplitudes.flatten(), "neighbours")
    shown = shown.model_copy(update={"noise": noise[:3]})
    finder = FlyingPixels(state.camera, state.depth_kind, shown)
    flying = sum(finder.found(*frame)[0].sum() for frame in frames)
    if flying <= wanted.false_alarm * depths.isfinite().sum():
        _LOG.warning("Flying pixels are not looked for: the recording shows none.")
        return None
    return shown
