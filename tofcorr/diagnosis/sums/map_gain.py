r"""Held-out gain by an effect that has one value for each cell of the image.

With the residual r, less the offset and tilts of its pose, and the weights w of the pixels of a
cell c, the value is

.. math:: v_c = \frac{\sum w r}{\sum w + s^{-2}} ,

with the prior standard deviation s, which is no less than what poses agree in. The weights are
those of the pixels' own noise. The dispersion says how much more sums over many pixels vary than
independent noise would make them, where neighbours share noise or show a smooth pattern; a cell is
no such sum.
"""

from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from tofcorr.diagnosis.sums.study import Study
from tofcorr.simulation.effects import MapEffect

MAP_SD = 0.003
"""Least prior standard deviation of a cell's value, metres. Chosen: the size of fixed patterns."""


class MapGain(NamedTuple):
    """The effect of subtracting a map.

    Attributes:
        gain: Fall of chi-squared of each held-out pose, shape (U,).
        values: The map's value in every pixel, estimated without the pixel's fold, shape (M,),
            metres.
        null: Total gain under every sign flip, shape (B,); empty if none was asked for.
    """

    gain: Tensor
    values: Tensor
    null: Tensor


def map_gain(
    study: Study,
    effect: MapEffect,
    residual: Tensor,
    left_out: Tensor | None = None,
    prior_sd: float | None = None,
) -> MapGain:
    """Estimate the map from the poses outside each fold, and judge it on those inside.

    Args:
        study: The recording.
        effect: Which map.
        residual: Of the model so far, shape (M,), metres.
        left_out: The residual with every pose left out of its own fit, shape (M,); its signs are
            flipped. None: no null distribution is drawn.
        prior_sd: Prior standard deviation of the values, metres; None: what poses agree in, and
            `MAP_SD` at least.
    """
    # Of large images few cells hold a chosen pixel.
    used, cells = effect.cells_of(study.inputs).unique(return_inverse=True)
    count = len(used)
    unit, weight, folds = study.unit_of_pixel, pixel_weight(study), study.folds
    fold = folds.argmax(0)[unit]
    systems = _systems(cells, weight, fold, len(folds), count)
    observed = _without_pose(study, residual)
    prior_sd = _spread(study, cells, observed, count) if prior_sd is None else prior_sd
    sums = _sums(cells, weight * observed, unit, count, study)
    values = torch.stack([own.sum(1) for own in _solved(systems, sums, study, prior_sd)])
    of_pixel = values[fold[:, None], cells].sum(-1)
    gain = study.weight * (2 * observed * of_pixel - of_pixel**2)
    zeros = torch.zeros(study.sums.num_units, dtype=torch.float64)
    null = torch.zeros(0, dtype=torch.float64)
    if left_out is not None:
        # What the map explains would widen the null distribution of a strong one.
        unexplained = _without_pose(study, left_out) - of_pixel
        sums = _sums(cells, weight * unexplained, unit, count, study)
        null = _null(systems, sums, study, prior_sd) / study.sums.dispersion
    return MapGain(
        gain=zeros.index_add(0, unit, gain),
        values=of_pixel,
        null=null,
    )


def whole_map(
    study: Study, effect: MapEffect, residual: Tensor, prior_sd: float | None = None
) -> Tensor:
    """Return the map's values estimated from all poses, shape (cells,), metres.

    The arguments are those of `map_gain`.
    """
    cells = effect.cells_of(study.inputs)
    count = effect.num_cells(effect.shape)
    one_fold = torch.zeros(len(cells), dtype=torch.int64)
    weight, observed = pixel_weight(study), _without_pose(study, residual)
    prior_sd = _spread(study, cells, observed, count) if prior_sd is None else prior_sd
    system = _systems(cells, weight, one_fold, 1, count)
    right = torch.zeros(count, dtype=torch.float64)
    for group in cells.unbind(1):
        right = right.index_add(0, group, weight * observed)
    prior = prior_sd**-2
    if system.ndim == 2:
        return right / (system[0] + prior)
    return torch.linalg.solve(system[0] + prior * torch.eye(count).double(), right)


def map_spread(study: Study, effect: MapEffect, residual: Tensor) -> float:
    """Return the prior standard deviation of a map's values, metres; the residual is of (M,)."""
    used, cells = effect.cells_of(study.inputs).unique(return_inverse=True)
    return _spread(study, cells, _without_pose(study, residual), len(used))


def pixel_weight(study: Study) -> Tensor:
    """Return the inverse variance of each pixel's own noise, shape (M,), 1 / m^2."""
    return study.fit.trust / study.fit.sigma**2


def _spread(study: Study, cells: Tensor, values: Tensor, count: int) -> float:
    """Return the root mean square of what poses agree in, cell by cell, `MAP_SD` at least, metres.

    The noise of two poses is independent, so that the products of different poses estimate it.
    """
    weight, unit, square = pixel_weight(study), study.unit_of_pixel, MAP_SD**2
    for group in cells.split(1, dim=1):
        own, seen = (_sums(group, x, unit, count, study) for x in (weight * values, weight))
        products, pairs = (float((x.sum(0) ** 2 - (x**2).sum(0)).sum()) for x in (own, seen))
        if pairs > 0:
            square = max(square, products / pairs)
    return square**0.5


def _without_pose(study: Study, residual: Tensor) -> Tensor:
    """Subtract the most probable offset and tilts of each pose, shape (M,)."""
    inner, score = study.pose_equations(residual)
    guess = torch.linalg.solve(inner + torch.diag(study.sums.pose_sd**-2), score)
    return residual - study.pose_surface(guess)


def _systems(cells: Tensor, weight: Tensor, fold: Tensor, folds: int, count: int) -> Tensor:
    """Return each fold's normal matrix, (folds, cells, cells), or its diagonal (folds, cells).

    Where a pixel lies in one cell only, the matrix is diagonal.
    """
    if cells.shape[1] == 1:
        flat = torch.zeros(folds * count, dtype=torch.float64)
        return flat.index_add(0, fold * count + cells[:, 0], weight).reshape(folds, count)
    matrix = torch.zeros(folds * count * count, dtype=torch.float64)
    for one in cells.unbind(1):
        for other in cells.unbind(1):
            matrix = matrix.index_add(0, (fold * count + one) * count + other, weight)
    return matrix.reshape(folds, count, count)


def _sums(cells: Tensor, values: Tensor, unit: Tensor, count: int, study: Study) -> Tensor:
    """Return the sum of values in each cell and pose, shape (U, cells)."""
    flat = torch.zeros(study.sums.num_units * count, dtype=torch.float64)
    for group in cells.unbind(1):
        flat = flat.index_add(0, unit * count + group, values)
    return flat.reshape(-1, count)


def _solved(systems: Tensor, sums: Tensor, study: Study, prior_sd: float) -> Iterator[Tensor]:
    """Yield for each fold what every pose adds to the map without the fold, shape (cells, U)."""
    whole, prior = systems.sum(0), prior_sd**-2
    for own, inside in zip(systems, study.folds, strict=True):
        right = (sums * (1 - inside[:, None])).T
        rest = whole - own
        if rest.ndim == 1:
            yield right / (rest + prior)[:, None]
        else:
            yield torch.linalg.solve(rest + prior * torch.eye(len(rest)).double(), right)


def _null(systems: Tensor, sums: Tensor, study: Study, prior_sd: float) -> Tensor:
    """Return the total held-out gain of every flip, shape (B,).

    The gain is a quadratic form of the signs, so that one matrix (U, U) serves all flips.
    """
    inside, signs = study.folds, study.signs
    form = torch.zeros(len(sums), len(sums), dtype=torch.float64)
    for fold, values in enumerate(_solved(systems, sums, study, prior_sd)):
        system = systems[fold]
        curved = system[:, None] * values if system.ndim == 1 else system @ values
        form.addmm_(values.T, 2 * (sums * inside[fold][:, None]).T - curved)
    return ((signs @ form) * signs).sum(1)
