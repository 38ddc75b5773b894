"""How much structure a residual contains, whatever its shape.

The mean product of residuals of different pixels in one small tile estimates the variance that they
share. Noise is independent, or its known share is subtracted (`SharedNoise`). Tiles are squares,
pieces of rows and pieces of columns, so that patches and stripes of both directions are detected.
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from tofcorr.diagnosis.sums.pose_offsets import pose_equations, pose_surface
from tofcorr.diagnosis.sums.small_tiles import small_tiles
from tofcorr.diagnosis.sums.study import Study

# Added to the pose equations, 1 / m^2, so that a pose of few pixels can be solved for.
_RIDGE = 1e-3


@dataclass(frozen=True, kw_only=True)
class Coherence:
    """Variances that pixels share, m^2.

    Attributes:
        within: Inside images, without each pose's offset and tilts; the largest over the shapes of
            tiles.
        within_error: Standard error of `within`, over frames.
        between: Of the offsets and tilts of poses.
        fixed: Of what is the same in every image; `within` contains part of it too.
        form: Shape of the tiles with the largest value: `squares`, `rows` or `columns`.
        noise_share: Share of the variance of the noise that was subtracted from `within`.
    """

    within: float
    within_error: float
    between: float
    fixed: float
    form: str
    noise_share: float = 0.0

    @property
    def total(self) -> float:
        """Within and between images together, m^2."""
        return max(self.within, 0.0) + max(self.between, 0.0)


def coherence(study: Study, residual: Tensor) -> Coherence:
    """Measure the structure of a residual, shape (M,), metres."""
    return coherence_inside(study, *without_pose(study, residual))


def coherence_inside(study: Study, inside: Tensor, between: float) -> Coherence:
    """Measure the structure of a residual, from what `without_pose` returns of it."""
    tiles = small_tiles(study.observations)
    per_form = {form: _beyond_noise(study, inside, form, cells) for form, cells in tiles.items()}
    form = max(per_form, key=lambda name: per_form[name][0])
    within, error = per_form[form]
    fixed = _fixed_square(study, inside)
    return Coherence(
        within=within,
        within_error=error,
        between=between,
        fixed=fixed,
        form=form,
        noise_share=study.fit.shared.share[form],
    )


def _beyond_noise(study: Study, residual: Tensor, form: str, cells: Tensor) -> tuple[float, float]:
    """Return what pixels of a tile share beyond noise, and its standard error, m^2."""
    mean, error = _shared(study, residual, cells)
    known, noise = study.fit.shared, study.fit.floor**2
    if known.share[form] == 0:
        return mean, error
    return mean - known.share[form] * noise, float(np.hypot(error, known.error[form] * noise))


def _shared(study: Study, residual: Tensor, cells: Tensor) -> tuple[float, float]:
    """Return the mean product of different pixels in a tile, and its standard error, m^2."""
    frame, share = study.observations.frame, study.fit.share
    cells = cells.unique(return_inverse=True)[1]
    size = int(cells.max()) + 1
    place = frame * size + cells
    count = study.observations.num_frames * size
    zeros = torch.zeros(count, dtype=torch.float64)
    total = zeros.index_add(0, place, share * residual)
    squares = zeros.index_add(0, place, (share * residual) ** 2)
    weight = zeros.index_add(0, place, share)
    weight_squares = zeros.index_add(0, place, share**2)
    frames = study.observations.num_frames
    products = (total**2 - squares).reshape(frames, size).sum(1)
    pairs = (weight**2 - weight_squares).reshape(frames, size).sum(1)
    mean = float(products.sum() / pairs.sum().clamp(min=1e-12))
    spread = (products - mean * pairs).square().sum().sqrt()
    return mean, float(spread / pairs.sum().clamp(min=1e-12))


def without_pose(study: Study, residual: Tensor) -> tuple[Tensor, float]:
    """Subtract each pose's offset and tilts; return their mean square too, less that of noise."""
    inner, score = pose_equations(study, residual)
    inner = inner + _RIDGE * torch.eye(3, dtype=torch.float64)
    own = torch.linalg.solve(inner, score)
    covariance = torch.linalg.inv(inner)
    surface = pose_surface(study, own)
    pose = study.system.pose
    noise = ((pose[:, None, :] @ covariance[study.unit_of_pixel])[:, 0] * pose).sum(1)
    share = study.fit.share
    between = float((share * (surface**2 - noise)).sum() / share.sum())
    return residual - surface, between


def _fixed_square(study: Study, residual: Tensor) -> float:
    """Return the mean square of what is the same in every image, from products between poses."""
    unit, share = study.unit_of_pixel, study.fit.share
    pixel = study.observations.pixel.unique(return_inverse=True)[1]
    size = int(pixel.max()) + 1
    total = torch.zeros(size, dtype=torch.float64).index_add(0, pixel, share * residual)
    count = torch.zeros(size, dtype=torch.float64).index_add(0, pixel, share)
    place = unit * size + pixel
    cells = study.system.blocks.num_units * size
    own = torch.zeros(cells, dtype=torch.float64).index_add(0, place, share * residual)
    own_count = torch.zeros(cells, dtype=torch.float64).index_add(0, place, share)
    products = total**2 - (own**2).reshape(-1, size).sum(0)
    pairs = count**2 - (own_count**2).reshape(-1, size).sum(0)
    return float(products.sum() / pairs.sum().clamp(min=1e-12))
