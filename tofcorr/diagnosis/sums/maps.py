r"""Maps: effects that have one value for each cell of the image, which are no columns.

With the residual r, less the offset and tilts of its pose, and the weights w of the pixels of a
cell c, the value is

.. math:: v_c = \frac{\sum w r}{\sum w + s^{-2}} ,

with the prior standard deviation s, which is no less than what poses agree in. The weights are
those of the pixels' own noise. The dispersion says how much more sums over many pixels vary than
independent noise would make them, where neighbours share noise or show a smooth pattern; a cell is
no such sum.
"""

from functools import cached_property
from itertools import product

import torch
from torch import Tensor

from tofcorr.diagnosis.sums.study import Study
from tofcorr.simulation.effects import MapEffect


class FittedMap:
    """A map fitted to what a model leaves.

    Args:
        study: The recording.
        effect: Which map.
        residual: Of the model so far, shape (M,), metres.
        prior_sd: Prior standard deviation of the values, metres; None: what poses agree in.
        least_sd: What is taken at least then, metres: the size of fixed patterns.

    Attributes:
        prior_sd: The one that was taken, metres.
    """

    def __init__(
        self,
        study: Study,
        effect: MapEffect,
        residual: Tensor,
        prior_sd: float | None = None,
        least_sd: float = 0.003,
    ) -> None:
        self._study, self._effect = study, effect
        # Of large images few cells hold a chosen pixel.
        self._used, self._cells = effect.cells_of(study.inputs.pixel).unique(return_inverse=True)
        self._observed = _without_pose(study, residual)
        self._sums = self._per_pose(self._cells, study.fit.weight * self._observed)
        self.prior_sd = max(self._agreed(), least_sd) if prior_sd is None else prior_sd

    def _per_pose(self, cells: Tensor, values: Tensor) -> Tensor:
        """Return the sum of values (M,) in each of some cells (M, C) and pose, (U, cells)."""
        sums = torch.zeros(self._study.sums.num_units, len(self._used), dtype=torch.float64)
        for group in cells.unbind(1):
            sums.index_put_((self._study.unit_of_pixel, group), values, accumulate=True)
        return sums

    def _agreed(self) -> float:
        """Return the root mean square of what poses agree in, cell by cell, metres.

        The noise of two poses is independent, so that the products of different poses estimate it.
        """
        weight, square = self._study.fit.weight, 0.0
        for group in self._cells.split(1, dim=1):
            own, seen = (self._per_pose(group, x) for x in (weight * self._observed, weight))
            products, pairs = (float((x.sum(0) ** 2 - (x**2).sum(0)).sum()) for x in (own, seen))
            if pairs > 0:
                square = max(square, products / pairs)
        return square**0.5

    @cached_property
    def _systems(self) -> Tensor:
        """Each fold's normal matrix, (folds, cells, cells), or its diagonal (folds, cells).

        Where a pixel lies in one cell only, the matrix is diagonal.
        """
        size, weight = [len(self._used)] * self._cells.shape[1], self._study.fit.weight
        systems = torch.zeros(len(self._study.folds), *size, dtype=torch.float64)
        for places in product(self._cells.unbind(1), repeat=len(size)):
            systems.index_put_((self._fold, *places), weight, accumulate=True)
        return systems

    @property
    def _fold(self) -> Tensor:
        """The fold that holds out each pixel, shape (M,)."""
        return self._study.folds.argmax(0)[self._study.unit_of_pixel]

    def _solved(self, system: Tensor, right: Tensor) -> Tensor:
        """Return the values of a right side (cells,)."""
        prior = self.prior_sd**-2
        if system.ndim == 1:
            return right / (system + prior)
        return torch.linalg.solve(system + prior * torch.eye(len(system)).double(), right)

    def whole(self) -> Tensor:
        """Return the map's values estimated from all poses, shape (cells,), metres."""
        found = self._solved(self._systems.sum(0), self._sums.sum(0))
        every = torch.zeros(len(self._effect.coefficients), dtype=torch.float64)
        return every.index_copy(0, self._used, found)

    @cached_property
    def values(self) -> Tensor:
        """The map's value in every pixel, estimated without the pixel's fold, (M,), metres."""
        kept, whole = (1 - self._study.folds) @ self._sums, self._systems.sum(0)
        pairs = zip(self._systems, kept, strict=True)
        of_folds = torch.stack([self._solved(whole - own, right) for own, right in pairs])
        return of_folds[self._fold[:, None], self._cells].sum(-1)


def _without_pose(study: Study, residual: Tensor) -> Tensor:
    """Subtract the most probable offset and tilts of each pose, shape (M,)."""
    inner, score = study.pose_equations(residual)
    guess = torch.linalg.solve(inner + torch.diag(study.sums.pose_sd**-2), score)
    return residual - study.pose_surface(guess)
