"""What effects may depend on, where a camera filters its images and neighbours share noise.

Effects that mix neighbouring pixels are computed of measured images. Where the noise of an image is
in part that of the pixel whose error is to be explained, they would explain noise.
"""

from dataclasses import replace

import torch
from torch import Tensor

from tofcorr.diagnosis.sums.base_fit import BaseFit
from tofcorr.diagnosis.sums.observations import Observations
from tofcorr.diagnosis.sums.prediction import predicted_images
from tofcorr.diagnosis.sums.robust_weights import MAD_TO_SIGMA
from tofcorr.simulation.effects.inputs import EffectInputs

# Beside the mask a pixel shows the target's plane if it is off by less than this many robust
# standard deviations. Chosen, as in the noise estimate.
_CLIP = 6.0
# Pixels of a frame that its offset and spread are taken from, at most. Chosen to bound the time.
_MOST_OF_FRAME = 20_000
# Whole images are predicted for this many pixels at a time. Chosen to bound memory.
_CHUNK_PIXELS = 4_000_000


def filtered_inputs(inputs: EffectInputs, observations: Observations, fit: BaseFit) -> EffectInputs:
    """Return the inputs without the noise that neighbours share; unchanged where they share none.

    Masks leave out parts of the target's plane: there too its distance is taken in place of the
    measured one. Amplitudes are as noisy as phases are, in radians.
    """
    if max(fit.shared.share.values()) == 0 or inputs.distance_images is None:
        return inputs
    images = _with_plane(inputs.distance_images, observations, fit.tool_from_camera)
    inputs = replace(inputs, distance_images=images, _remembered={})
    if inputs.amplitude is None or inputs.modulation_frequency is None:
        return inputs
    noise = inputs.amplitude * fit.sigma / inputs.metres_per_radian
    return replace(inputs, amplitude_noise=noise)


def _with_plane(images: Tensor, observations: Observations, tool_from_camera: Tensor) -> Tensor:
    """Return distances (F, H, W) with the plane's where measured ones are off it by noise alone."""
    found = []
    step = max(1, _CHUNK_PIXELS // images[0].numel())
    for start in range(0, len(images), step):
        part = slice(start, start + step)
        plane = predicted_images(observations, tool_from_camera, part)
        measured = observations.distance_images[part]
        off = measured.double() - plane
        use = observations.on_target[part] & (measured > 0)
        middle = _median(off, use)
        away = (off - middle).abs()
        beside = (measured > 0) & (away < _CLIP * MAD_TO_SIGMA * _median(away, use))
        found.append(torch.where(beside, plane.float(), images[part]))
    return torch.cat(found)


def _median(images: Tensor, use: Tensor) -> Tensor:
    """Return the median of used pixels of each image, (F, 1, 1); NaN where there are none."""
    step = max(1, images[0].numel() // _MOST_OF_FRAME)
    chosen = torch.where(use, images, torch.nan).flatten(1)[:, ::step]
    return chosen.nanmedian(1).values[:, None, None]
