"""What flips of whole poses leave of sums of residuals once the model is fitted to them again.

Flipped residuals are no residuals: a fit would take part of them away, as it did of the observed
ones. Compared with them as they are, biases that the model absorbs hide those that it does not.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from tofcorr.diagnosis.sums.study import Study

# Pixels that tell how much of a sum a fit takes, at most, evenly spread. Chosen: a sum over a tenth
# of them is known to 2 %, well below `_LEAST_LEFT` of `where`.
_MOST_PIXELS = 20_000


class Flips:
    """Flips of residuals of what was not fitted: nothing is taken away.

    Args:
        study: The recording.
    """

    def __init__(self, study: Study) -> None:
        signs = study.resampling.signs
        # The first column is the observed residual.
        self._signs = torch.cat([torch.ones_like(signs[:1]), signs]).T

    def bins(self, sums: Tensor, place: Tensor) -> Tensor:
        """Return sums over bins, observed and of every flip, shape (bins, 1 + B).

        Args:
            sums: Weighted residuals of every bin and pose, shape (bins, U).
            place: Bin of each pixel, shape (M,), int64.
        """
        return sums @ self._signs

    def line(self, sums: Tensor, along: Tensor) -> Tensor:
        """Return sums weighted by position along a line, shape (1, 1 + B).

        Args:
            sums: Of every pose, shape (1, U).
            along: Position of each pixel, shape (M,).
        """
        return sums @ self._signs


class RefittedFlips(Flips):
    """The same for a model that is fitted to flipped residuals.

    Args:
        study: The recording.
        chosen: Effects of the model.
        residual: Shape (M,), metres.
    """

    def __init__(self, study: Study, chosen: Sequence[str], residual: Tensor) -> None:
        super().__init__(study)
        columns, sums = study.system.columns.of(chosen), study.system.blocks.even
        even = study.system.blocks.even_scale * study.fit.share * residual
        scores = [study.observations.products(own, even[:, None])[..., 0] for own in columns]
        members = sums.layout.of(chosen)
        normal = sums.total[members][:, members] + sums.layout.prior_of(members)
        self._theta = torch.linalg.solve(normal, torch.cat(scores, dim=1).T @ self._signs)
        self._step = step = max(1, len(residual) // _MOST_PIXELS)
        self._weighted = torch.cat([own[::step] for own in columns], dim=1)
        self._weighted = self._weighted * (step * study.weight[::step, None])

    def bins(self, sums: Tensor, place: Tensor) -> Tensor:
        """Return sums over bins, less what the model takes of them."""
        across = torch.zeros(len(sums), self._weighted.shape[1], dtype=torch.float64)
        across.index_add_(0, place[:: self._step], self._weighted)
        return super().bins(sums, place) - across @ self._theta

    def line(self, sums: Tensor, along: Tensor) -> Tensor:
        """Return sums along a line, less what the model takes of them."""
        across = along[:: self._step] @ self._weighted
        return super().line(sums, along) - across @ self._theta
