"""The weight of each pixel in a fit: by its noise, and by its distance to the plane."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from pydantic import PositiveInt
from torch import Tensor

from tofcorr.correction.model import CalibrationModel
from tofcorr.data.recording import FrameBatch
from tofcorr.estimation.accumulator import Design
from tofcorr.estimation.moments import ImageMoments
from tofcorr.estimation.noise import DistanceNoise
from tofcorr.estimation.robust import RobustLoss, robust_scale, robust_weights
from tofcorr.options import Options
from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.sample import distance_to_plane, estimate_noise

# About how many pixels the scale of the residuals is taken from. Set by hand.
_SAMPLE_PIXELS = 200_000
# Reweighting ends when no entry of the hand-eye transform and no coefficient changes by more than
# this between passes: metres, or no unit for the rotation's entries. Set by hand, far below any
# standard error.
_SETTLED = 1e-6
# Least variance relative to the typical one, so that no pixel's weight exceeds a million. Set by
# hand.
_LEAST_VARIANCE = 1e-6
# Least scale of the residuals, metres, for data without noise. Set by hand.
_LEAST_SCALE = 1e-9


class WeightOptions(Options):
    """The weight of each pixel.

    Attributes:
        noise: Whether a pixel's weight is one over its noise variance, estimated from frames of
            one pose, or else from neighbouring pixels.
        robust: The robust loss: `huber` bounds the influence of an outlier, with `cauchy` that of
            a gross one vanishes.
        passes: Most passes of reweighting.
    """

    noise: bool = False
    robust: RobustLoss = "none"
    passes: PositiveInt = 20


@dataclass(frozen=True)
class PixelWeights:
    """Gives the weights of a batch's pixels, without unit; a typical pixel has weight 1.

    Attributes:
        ray_directions: Unit rays, shape (H, W, 3).
        noise: A pixel's weight is one over its variance; None: all have the same weight.
        typical_variance: The variance of weight 1, square metres.
        loss: The robust loss.
        model: The model whose residuals the robust weights look at; None before the first fit.
        scale: Standard deviation of the distances to the plane, metres, where the weight is 1.
    """

    ray_directions: Tensor
    noise: DistanceNoise | None = None
    typical_variance: float = 1.0
    loss: RobustLoss = "none"
    model: CalibrationModel | None = None
    scale: float = 1.0

    def __call__(self, batch: FrameBatch) -> Tensor:
        """Return weights, shape (B, H, W); undefined where a pixel is not valid."""
        variance = self.relative_variance(batch)
        weights = 1 / variance
        if self.loss == "none" or self.model is None:
            return weights
        standardised = self.distance_to_plane(batch) / (self.scale * variance.sqrt())
        return weights * robust_weights(standardised, self.loss)

    def relative_variance(self, batch: FrameBatch) -> Tensor:
        """Return the noise's variance relative to the typical one, shape (B, H, W)."""
        if self.noise is None or batch.amplitude is None:
            return torch.ones_like(batch.radial_distance)
        amplitude = torch.where(batch.valid, batch.amplitude, 1.0)
        variance = self.noise.variance(amplitude) / self.typical_variance
        # A pixel without any amplitude has infinite variance, and then no weight.
        return variance.clamp(min=_LEAST_VARIANCE)

    def distance_to_plane(self, batch: FrameBatch) -> Tensor:
        """Return signed distances of corrected points to their plane, shape (B, H, W), metres."""
        assert self.model is not None
        return distance_to_plane(self.model, batch, self.ray_directions)

    def updated(
        self, dataset: Dataset, frames: Sequence[int] | np.ndarray, model: CalibrationModel
    ) -> "PixelWeights":
        """Return the weights under another model: one pass over a sample of the pixels."""
        found = replace(self, model=model)
        camera = dataset.first.camera
        step = max(len(frames) * camera.height * camera.width // _SAMPLE_PIXELS, 1)
        sample = [
            (found.distance_to_plane(batch) / found.relative_variance(batch).sqrt())[batch.valid]
            for batch in dataset.batches(frames)
        ]
        return replace(found, scale=max(robust_scale(torch.cat(sample)[::step]), _LEAST_SCALE))


def first_weights(
    dataset: Dataset, frames: Sequence[int] | np.ndarray, noise: bool, loss: RobustLoss
) -> PixelWeights:
    """Return the weights before any fit.

    Args:
        dataset: The recordings.
        frames: Global numbers of the frames to fit.
        noise: Whether pixels are weighted by their noise.
        loss: The robust loss.

    Raises:
        CalibrationDataError: The noise cannot be estimated.
    """
    rays = dataset.ray_directions()
    if not noise:
        return PixelWeights(rays, loss=loss)
    model = estimate_noise(dataset, frames)
    inverse = [
        (1 / model.variance(batch.amplitude[batch.valid])).mean()
        for batch in dataset.batches(frames)
        if batch.amplitude is not None and bool(batch.valid.any())
    ]
    return PixelWeights(rays, model, 1 / float(torch.stack(inverse).mean()), loss)


def weighted_moments(
    dataset: Dataset,
    frames: Sequence[int] | np.ndarray,
    design: Design,
    options: WeightOptions,
    fitted: Callable[[ImageMoments], tuple[CalibrationModel, Dataset]],
    device: str = "cpu",
) -> tuple[ImageMoments, PixelWeights | None]:
    """Return the moments of some frames, with each pixel weighted as the options say.

    Robust weights depend on the fit, and the fit on them. Both are computed in turn, with a pass
    over the pixels each time, until the fit no longer changes.

    Args:
        dataset: The recordings.
        frames: Global numbers of the frames.
        design: The columns.
        options: How pixels are weighted.
        fitted: Fits a model to moments; returns it, and the data set with the walls of the fit.
        device: Where the passes run.

    Returns:
        The moments, on the walls of the last fit; the weights, None if all pixels have the same.
    """
    if not options.noise and options.robust == "none":
        return dataset.moments(design, frames, device=device), None
    weights = first_weights(dataset, frames, options.noise, options.robust)
    moments = dataset.moments(design, frames, weights, device)
    if options.robust == "none":
        return moments, weights
    before = None
    for _ in range(options.passes):
        model, seen = fitted(moments)
        now = _state(model)
        if before is not None and float((now - before).abs().max()) < _SETTLED:
            break
        before = now
        weights = weights.updated(seen, frames, model)
        moments = seen.moments(design, frames, weights, device)
    return moments, weights


def _state(model: CalibrationModel) -> Tensor:
    with torch.no_grad():
        return torch.cat([model.hand_eye().flatten(), model.error.coefficient_vector()])
