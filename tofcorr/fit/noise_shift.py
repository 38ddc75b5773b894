r"""How far the noise of the measured distances moves the hand-eye transform (errors in variables).

The error terms are functions of the measured distance D, which has noise of variance s^2. A pixel's
squared residual therefore contains, beyond the noise of its plane distance,

.. math:: s^2 \Big(\cos\theta\,\big(1 - \textstyle\sum_k \beta_k f_k'(D)\big)\Big)^2 ,

which is smaller where the correction shrinks all distances. The fit does so a little, and the
hand-eye transform makes up for it, above all along the viewing direction. No scatter between poses
shows that: it is the same in all of them. The expected term is a quadratic form like the moments,
with the columns' derivatives in place of the columns (the corrected score of Nakamura 1990), so one
Newton step without it says how far the fit has moved.
"""

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from tofcorr.data.frames import FrameBatch
from tofcorr.errors import CalibrationDataError
from tofcorr.estimation.design import Design
from tofcorr.estimation.moments import ImageMoments
from tofcorr.estimation.noise import DistanceNoise
from tofcorr.estimation.planes import joint_image_equations
from tofcorr.fit.inputs import build_model
from tofcorr.fit.result import Fit
from tofcorr.fit.weighting import PixelWeights
from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.noise_sample import estimate_noise

# About how many pixels the expected term is summed over, in at least so many evenly spread frames.
# Chosen: the shift of many pixels is known far better than it needs to be, in milliseconds.
_PIXELS = 50_000
_FEWEST_FRAMES = 16
# Largest variance of a distance, square metres: without amplitude it is infinite. Chosen, far above
# that of any pixel that counts.
_MOST_VARIANCE = 0.01
# Step of the derivative by the distance, metres. Chosen, far below any error's scale.
_STEP = 1e-4
# Curvature below this share of the largest is left out: without the noise's share nothing is left.
# Chosen, far above rounding.
_RESOLVED = 1e-9


def with_noise(fit: Fit, dataset: Dataset, frames: np.ndarray) -> Fit:
    """Return a fit with the noise of its distances, and what that does to the hand-eye transform.

    Args:
        fit: The fitted model.
        dataset: The recordings, on the walls of the fit.
        frames: Global numbers of the frames fitted, increasing.
    """
    noise = _noise_of(fit, dataset, frames)
    if noise is None or not fit.solution.parameters.hand_eye_is_free:
        return replace(fit, noise=noise)
    return replace(fit, noise=noise, noise_shift=_shift(fit, dataset, frames, noise))


def _noise_of(fit: Fit, dataset: Dataset, frames: np.ndarray) -> DistanceNoise | None:
    """Return the noise of a measured distance; None where the recording does not determine it."""
    if fit.weights is not None and fit.weights.noise is not None:
        return fit.weights.noise
    if not dataset.has_amplitude:
        return None
    try:
        return estimate_noise(dataset, frames)
    except CalibrationDataError:
        return None


def _shift(fit: Fit, dataset: Dataset, frames: np.ndarray, noise: DistanceNoise) -> Tensor:
    """Return how far the noise moves the hand-eye transform: a twist in camera axes, (6,)."""
    optimum = fit.solution.parameters
    walls = None if fit.walls is None else fit.walls.walls
    whole = joint_image_equations(fit.moments, optimum, walls).hessian.sum(dim=0)
    excess = joint_image_equations(_expected(fit, dataset, frames, noise), optimum, walls)
    hessian, size = whole - excess.hessian.sum(dim=0), optimum.size
    if fit.total_prior is not None:
        hessian[:size, :size] += fit.total_prior.equations(optimum).hessian
    scale = hessian.diagonal().clamp(min=1e-300).sqrt()
    values, vectors = torch.linalg.eigh(hessian / scale[:, None] / scale[None, :])
    resolved = values > _RESOLVED * values.max()
    basis = vectors[:, resolved] / scale[:, None]
    step = basis @ ((basis.T @ excess.gradient.sum(dim=0)) / values[resolved])
    return -step[:6]


def _expected(fit: Fit, dataset: Dataset, frames: np.ndarray, noise: DistanceNoise) -> ImageMoments:
    """Return what the noise adds to the moments, estimated from some frames and pixels."""
    _, design = build_model(dataset, fit.options, fit.domain)
    places = [0, *(1 + fit.moments.symbols.index(symbol) for symbol in design.symbols)]
    entries = torch.tensor([3 * place + axis for place in places for axis in range(3)])
    count = max(_FEWEST_FRAMES, _PIXELS // dataset.ray_directions()[..., 0].numel())
    count = min(count, len(frames))
    chosen = np.unique(np.linspace(0, len(frames) - 1, count).astype(int))
    gram, number = torch.zeros_like(fit.moments.gram), iter(chosen.tolist())
    for batch in dataset.batches(frames[chosen]):
        weights = _weights(fit.weights, batch)
        for k in range(len(batch.radial_distance)):
            assert batch.amplitude is not None
            valid = batch.valid[k].nonzero()
            some = valid[:: max(1, len(valid) * len(chosen) // _PIXELS)].unbind(1)
            own = _of_pixels(design, batch.radial_distance[k][some], batch.amplitude[k][some], some)
            variance = noise.variance(batch.amplitude[k][some]).clamp(max=_MOST_VARIANCE)
            variance = variance * weights[k][some]
            share = len(valid) / max(len(some[0]), 1) * len(frames) / len(chosen)
            place = next(number)
            gram[place, entries[:, None], entries] = share * (own * variance) @ own.T
    return replace(fit.moments, gram=gram)


def _weights(weights: PixelWeights | None, batch: FrameBatch) -> Tensor:
    """Return the weight of each pixel in the fit, shape (B, H, W)."""
    return torch.ones_like(batch.radial_distance) if weights is None else weights(batch)


def _of_pixels(
    design: Design, distance: Tensor, amplitude: Tensor, at: tuple[Tensor, ...]
) -> Tensor:
    """Return the derivatives of the columns with their rays by the distance, (3 C, M)."""
    near, far = (design.signal_functions(distance + h, amplitude) for h in (-_STEP, _STEP))
    slope = ((far - near) / (2 * _STEP))[design.signal]
    columns = slope * design.pixel_functions[:, *at][design.pixel]
    return (columns[:, None, :] * design.ray_directions[at].T).flatten(0, 1)
