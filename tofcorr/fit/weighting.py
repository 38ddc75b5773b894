"""The weight of each pixel in a fit: by its noise, and by its distance to the plane."""

from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from tofcorr.correction.model import CalibrationModel
from tofcorr.data.recording import FrameBatch
from tofcorr.estimation.moments import LEAST_RESIDUAL
from tofcorr.estimation.noise import DistanceNoise
from tofcorr.estimation.robust import RobustLoss, robust_scale, robust_weights
from tofcorr.pixels.dataset import Dataset, Frames
from tofcorr.pixels.lattice import Lattice, estimate_noise
from tofcorr.pixels.sample import FramePixels, distance_to_plane


@dataclass(frozen=True)
class PixelWeights:
    """Gives the weights of pixels, without unit; a typical pixel has weight 1.

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
        return self._of(*self._seen(batch))

    def of_sample(self, sample: FramePixels) -> Tensor:
        """Return the weights of some pixels, shape (M,)."""
        distance = sample.pixels.radial_distance
        if self.model is not None:
            error = self.model.error.error_at(sample.pixels)
            distance = sample.distance_to_plane(self.model.hand_eye().detach(), error)
        return self._of(sample.pixels.amplitude, distance)

    def updated(self, dataset: Dataset, frames: Frames, model: CalibrationModel) -> "PixelWeights":
        """Return the weights under another model: one pass over a sample of the pixels."""
        found = replace(self, model=model)
        sample = []
        for batch in dataset.batches(frames):
            amplitude, distance = found._seen(batch)
            standard = distance / found._relative_variance(amplitude, distance).sqrt()
            sample.append(standard[batch.valid])
        # The median of 200 000 residuals, about, is known far better than a robust weight needs it.
        camera = dataset.first.camera
        step = max(len(frames) * camera.height * camera.width // 200_000, 1)
        return replace(found, scale=max(robust_scale(torch.cat(sample)[::step]), LEAST_RESIDUAL))

    def to_mapping(self) -> dict[str, Any]:
        """Return how pixels are weighted, for the report."""
        return {
            "noise": None if self.noise is None else self.noise._asdict(),
            "robust": self.loss,
            "scale_mm": None if self.model is None else 1e3 * self.scale,
        }

    def _seen(self, batch: FrameBatch) -> tuple[Tensor | None, Tensor]:
        """Return amplitudes, 1 where not valid, and distances to the plane under the model."""
        amplitude, distance = batch.amplitude, batch.radial_distance
        if self.model is not None:
            distance, _ = distance_to_plane(self.model, batch, self.ray_directions)
        return None if amplitude is None else torch.where(batch.valid, amplitude, 1.0), distance

    def _of(self, amplitude: Tensor | None, distance: Tensor) -> Tensor:
        variance = self._relative_variance(amplitude, distance)
        if self.model is None:
            return 1 / variance
        return robust_weights(distance / (self.scale * variance.sqrt()), self.loss) / variance

    def _relative_variance(self, amplitude: Tensor | None, like: Tensor) -> Tensor:
        """Return the noise's variance relative to the typical one."""
        if self.noise is None or amplitude is None:
            return torch.ones_like(like)
        # A pixel without any amplitude has infinite variance, and then no weight.
        return self.noise.variance(amplitude).clamp(min=LEAST_RESIDUAL**2) / self.typical_variance


def first_weights(
    dataset: Dataset, frames: Frames, lattice: Lattice | None, noise: bool, loss: RobustLoss
) -> PixelWeights | None:
    """Return the weights before any fit; None if all pixels have the same.

    Args:
        dataset: The recordings.
        frames: Global numbers of the frames to fit.
        lattice: Evenly spread pixels of them; None: they are read.
        noise: Whether pixels are weighted by their noise.
        loss: The robust loss.

    Raises:
        CalibrationDataError: The noise cannot be estimated.
    """
    rays = dataset.ray_directions()
    if not noise:
        return None if loss == "none" else PixelWeights(rays, loss=loss)
    model = estimate_noise(dataset, frames, lattice)
    inverse = [
        (1 / model.variance(batch.amplitude[batch.valid])).mean()
        for batch in dataset.batches(frames)
        if batch.amplitude is not None and bool(batch.valid.any())
    ]
    return PixelWeights(rays, model, 1 / float(torch.stack(inverse).mean()), loss)
