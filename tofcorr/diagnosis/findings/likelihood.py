"""What effects gain in likelihood, pose by pose."""

from collections.abc import Sequence
from dataclasses import replace

from torch import Tensor

from tofcorr.diagnosis.sums.additions import HeldOutSquares
from tofcorr.diagnosis.sums.study import Study


class Likelihood:
    """Chi-squared of held-out poses, by a model and by one more effect.

    It knows that poses scatter, and so which part of what an effect closes is a shift of single
    images, and which part has the effect's own shape within them.

    Args:
        study: The recording.
        chosen: Effects of the model, all with columns.
    """

    def __init__(self, study: Study, chosen: Sequence[str]) -> None:
        blocks = study.system.blocks
        weighted = replace(blocks, even=blocks.likely, even_scale=1.0)
        self._squares = HeldOutSquares(weighted, chosen, study.resampling.folds)

    def gains(self, name: str) -> Tensor:
        """Return the fall of chi-squared of each pose by one more effect, shape (U,)."""
        return self._squares.closed(name)

    def gains_of(self, larger: "Likelihood") -> Tensor:
        """Return the fall of chi-squared of each pose by a larger model, shape (U,)."""
        return self._squares.squares - larger._squares.squares
