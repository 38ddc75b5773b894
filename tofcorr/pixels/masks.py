"""Which pixels are used: masks against outliers, other surfaces, edges and grazing incidence."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float
from pydantic import Field, PositiveFloat
from torch import Tensor

from tofcorr.data.frames import FrameBatch
from tofcorr.errors import CalibrationDataError
from tofcorr.options import Options
from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.outliers import without_outliers
from tofcorr.pixels.ransac import NotOnLargestPlane
from tofcorr.pixels.walls import ENOUGH_FOR_MASKS, OffTheWall, image_planes


class MaskOptions(Options):
    """Which pixels are used.

    Attributes:
        outlier_window_mm: Pixels whose raw error (before any fit) is further than this from the
            median raw error are not used; null uses all.
        edge_contrast: Pixels are left out whose 3 x 3 neighbourhood is brighter by this factor at
            one place than at another; null keeps them.
        grazing_deg: Pixels are left out that see the wall at a larger angle from its normal; null
            keeps them.
        mask: `recording`: pixels look at the wall where mask.npy says so, or everywhere without
            it; `ransac`: where they lie on the largest plane of their image.
        mask_tolerance_mm: How far a pixel may lie from that plane.
    """

    outlier_window_mm: PositiveFloat | None = None
    edge_contrast: float | None = Field(default=None, gt=1.0)
    grazing_deg: float | None = Field(default=None, gt=0.0, lt=90.0)
    mask: Literal["recording", "ransac"] = "recording"
    mask_tolerance_mm: PositiveFloat = 30.0


@dataclass(frozen=True)
class Edges:
    """Finds pixels next to an edge of reflectivity, which mix the light of two surfaces.

    Attributes:
        contrast: Brightest over darkest pixel of a 3 x 3 neighbourhood from which it is an edge.
    """

    contrast: float

    def __call__(self, batch: FrameBatch) -> Bool[Tensor, "B H W"]:
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
    """Finds pixels that see the wall too obliquely: multipath and lateral errors are large there.

    The wall's direction is fitted to the measured points; no hand-eye transform is needed.

    Attributes:
        limit_deg: Largest angle between the ray and the wall's normal, degrees.
        ray_directions: Unit rays, shape (H, W, 3).
    """

    limit_deg: float
    ray_directions: Float[Tensor, "H W 3"]

    def __call__(self, batch: FrameBatch) -> Bool[Tensor, "B H W"]:
        """Return True where the incidence is too grazing, shape (B, H, W)."""
        rays = self.ray_directions.to(batch.radial_distance)
        normal = image_planes(batch, rays, ENOUGH_FOR_MASKS).normal
        cosine = torch.einsum("hwa,ba->bhw", rays, normal).abs()
        return cosine < math.cos(math.radians(self.limit_deg))


def with_exclusion(
    dataset: Dataset, exclude: Callable[[FrameBatch], Bool[Tensor, "B H W"]]
) -> Dataset:
    """Return the data set without further pixels."""
    first = dataset.exclude
    if first is None:
        return replace(dataset, exclude=exclude)
    return replace(dataset, exclude=lambda batch: first(batch) | exclude(batch))


def usable_pixels(
    dataset: Dataset,
    options: MaskOptions,
    *,
    robust: bool,
    frames: Sequence[int] | np.ndarray | None = None,
) -> Dataset:
    """Return the data set without the pixels that the options leave out.

    Args:
        dataset: The recordings.
        options: Which pixels are used.
        robust: Whether the fit uses robust weights. These need a start without gross outliers,
            so pixels far off the plane of most of their image are left out too.
        frames: Global numbers of the frames whose pixels decide where the outlier window lies;
            None: all. Every other mask looks at one image alone.

    Raises:
        CalibrationDataError: `edge_contrast` is set and there are no amplitudes, or no pixel is
            within `outlier_window_mm`; or that is set and the planes are estimated.
    """
    if options.outlier_window_mm is not None and dataset.planes_are_estimated:
        raise CalibrationDataError(
            f"{dataset.first.path}: outlier_window_mm compares with the recorded planes, and these "
            "are estimated from the depth (recording.yaml: planes); use weights.robust or mask: "
            "ransac instead."
        )
    dataset = without_outliers(dataset, options.outlier_window_mm, frames)
    rays = dataset.ray_directions()
    masks: list[Mask] = []
    if options.mask == "ransac":
        masks.append(NotOnLargestPlane(rays, options.mask_tolerance_mm * 1e-3))
    if options.edge_contrast is not None:
        dataset.require("amplitude", "the mask of edges (edge_contrast)")
        masks.append(Edges(options.edge_contrast))
    if options.grazing_deg is not None:
        masks.append(Grazing(options.grazing_deg, rays))
    if robust:
        masks.append(OffTheWall(rays))
    for mask in masks:
        dataset = with_exclusion(dataset, mask)
    return dataset
