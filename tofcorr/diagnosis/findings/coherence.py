"""How much structure a residual holds, whatever its form.

Noise of different pixels is independent. The mean product of residuals of different pixels in
one small tile therefore estimates what they share, without a noise floor. Tiles are squares,
pieces of rows and pieces of columns, so that stripes either way and blobs are felt.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from tofcorr.diagnosis.sums.study import Study

# Pixels in a tile on the average.
_PER_TILE = 12.0


@dataclass(frozen=True, kw_only=True)
class Coherence:
    """Mean squares of what pixels share, m^2.

    Attributes:
        within: Inside images, after each pose's own offset and tilts, the largest over tile forms.
        within_error: Its standard error over poses.
        between: Offsets and tilts of poses.
        fixed: What is the same in every image; part of it may be in `within` too.
        form: Of the tile with the largest: `squares`, `rows` or `columns`.
    """

    within: float
    within_error: float
    between: float
    fixed: float
    form: str

    @property
    def total(self) -> float:
        """Both together, m^2."""
        return max(self.within, 0.0) + max(self.between, 0.0)


def coherence(study: Study, residual: Tensor) -> Coherence:
    """Measure the structure of a residual, shape (M,), metres."""
    inside, between = _without_pose(study, residual)
    per_form = {form: _shared(study, inside, cells) for form, cells in _tiles(study).items()}
    form = max(per_form, key=lambda name: per_form[name][0])
    within, error = per_form[form]
    fixed = _fixed_square(study, inside)
    return Coherence(within=within, within_error=error, between=between, fixed=fixed, form=form)


def _tiles(study: Study) -> dict[str, Tensor]:
    """Return the tile of every pixel, for each form of tile."""
    camera = study.observations.recording.camera
    pixel = study.observations.pixel
    row, column = pixel // camera.width, pixel % camera.width
    frames = study.observations.num_frames
    density = len(pixel) / (frames * camera.height * camera.width)
    if study.observations.recording.mask is not None:
        seen = float(study.observations.on_target.double().mean())
        density = density / max(seen, 1e-6)
    area = _PER_TILE / min(max(density, 1e-6), 1.0)
    side = max(2, round(area**0.5))
    length = max(2, round(area))
    return {
        "squares": row // side * camera.width + column // side,
        "rows": row * camera.width + column // length,
        "columns": row // length * camera.width + column,
    }


def _shared(study: Study, residual: Tensor, cells: Tensor) -> tuple[float, float]:
    """Return the mean product of different pixels in a tile, and its standard error, m^2."""
    frame, share = study.observations.frame, study.fit.share
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


def _without_pose(study: Study, residual: Tensor) -> tuple[Tensor, float]:
    """Take off each pose's own offset and tilts; return their mean square over the noise too."""
    weight, unit, pose = study.weight, study.unit_of_pixel, study.pose
    units = study.blocks.num_units
    weighted = pose * weight[:, None]
    inner = torch.zeros(units, 3, 3, dtype=torch.float64)
    inner.index_add_(0, unit, weighted[:, :, None] * pose[:, None, :])
    inner = inner + 1e-3 * torch.eye(3, dtype=torch.float64)
    score = torch.zeros(units, 3, dtype=torch.float64)
    score.index_add_(0, unit, weighted * residual[:, None])
    own = torch.linalg.solve(inner, score)
    scatter = torch.linalg.inv(inner)
    surface = (pose * own[unit]).sum(1)
    chance = ((pose[:, None, :] @ scatter[unit])[:, 0] * pose).sum(1)
    share = study.fit.share
    between = float((share * (surface**2 - chance)).sum() / share.sum())
    return residual - surface, between


def _fixed_square(study: Study, residual: Tensor) -> float:
    """Return the mean square of what is the same in every image, from products between poses."""
    pixel, unit, share = study.observations.pixel, study.unit_of_pixel, study.fit.share
    size = int(pixel.max()) + 1
    total = torch.zeros(size, dtype=torch.float64).index_add(0, pixel, share * residual)
    count = torch.zeros(size, dtype=torch.float64).index_add(0, pixel, share)
    place = unit * size + pixel
    cells = study.blocks.num_units * size
    own = torch.zeros(cells, dtype=torch.float64).index_add(0, place, share * residual)
    own_count = torch.zeros(cells, dtype=torch.float64).index_add(0, place, share)
    products = total**2 - (own**2).reshape(-1, size).sum(0)
    pairs = count**2 - (own_count**2).reshape(-1, size).sum(0)
    return float(products.sum() / pairs.sum().clamp(min=1e-12))
