"""Pixels left out for what they look at: edges of reflectivity, grazing incidence."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from tofcorr.data.frames import FrameBatch
from tofcorr.training.dataset import Dataset
from tofcorr.training.options import TrainingOptions
from tofcorr.training.outliers import without_outliers
from tofcorr.training.ransac import NotOnLargestPlane
from tofcorr.training.walls import OffTheWall, image_planes


@dataclass(frozen=True)
class Edges:
    """Pixels next to an edge of reflectivity mix two surfaces' light.

    Attributes:
        contrast: Brightest over darkest pixel of a 3 x 3 neighbourhood from which it is an edge.
    """

    contrast: float

    def __call__(self, batch: FrameBatch) -> Tensor:
        """Return True on edges, shape (B, H, W); nowhere without amplitudes."""
        if batch.amplitude is None:
            return torch.zeros_like(batch.valid)
        usable = batch.valid
        pool = torch.nn.functional.max_pool2d
        high = torch.where(usable, batch.amplitude, 0.0)
        low = torch.where(usable, batch.amplitude, torch.inf)
        brightest = pool(high[:, None], 3, stride=1, padding=1)[:, 0]
        darkest = -pool(-low[:, None], 3, stride=1, padding=1)[:, 0]
        return brightest > self.contrast * darkest


@dataclass(frozen=True)
class Grazing:
    """Pixels that see the wall too obliquely: multiple reflections and lateral errors grow there.

    The wall's direction is taken from the measured points, so that the hand-eye transform need
    not be known.

    Attributes:
        limit_deg: Largest angle between the ray and the wall's normal, degrees.
        ray_directions: Unit rays, shape (H, W, 3).
    """

    limit_deg: float
    ray_directions: Tensor

    def __call__(self, batch: FrameBatch) -> Tensor:
        """Return True where the incidence is too grazing, shape (B, H, W)."""
        rays = self.ray_directions.to(batch.radial_distance)
        normal = image_planes(batch, rays).normal
        cosine = torch.einsum("hwa,ba->bhw", rays, normal).abs()
        return cosine < math.cos(math.radians(self.limit_deg))


def with_exclusion(dataset: Dataset, exclude: Callable[[FrameBatch], Tensor]) -> Dataset:
    """Return the data set without further pixels."""
    first = dataset.exclude
    if first is None:
        return replace(dataset, exclude=exclude)
    return replace(dataset, exclude=lambda batch: first(batch) | exclude(batch))


def usable_pixels(dataset: Dataset, options: TrainingOptions) -> Dataset:
    """Return the data set without the pixels that the options do not want.

    Robust weights need a start that outliers have not spoilt: with them, pixels grossly off the
    plane that most of their image lies on are left out from the beginning.

    Raises:
        CalibrationDataError: Edges are to be left out and there are no amplitudes.
    """
    dataset = without_outliers(dataset, options.outlier_window_mm)
    rays = dataset.ray_directions()
    if options.mask == "ransac":
        tolerance = options.mask_tolerance_mm * 1e-3
        dataset = with_exclusion(dataset, NotOnLargestPlane(rays, tolerance))
    if options.edge_contrast is not None:
        dataset.require("amplitude", "the mask of edges (edge_contrast)")
        dataset = with_exclusion(dataset, Edges(options.edge_contrast))
    if options.grazing_deg is not None:
        dataset = with_exclusion(dataset, Grazing(options.grazing_deg, rays))
    if options.weights.robust != "none":
        dataset = with_exclusion(dataset, OffTheWall(rays))
    return dataset
