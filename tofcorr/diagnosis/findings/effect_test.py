"""The test of one effect as an addition to a model: what it gains, and what chance would."""

import math
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

NORMAL_95 = 1.6449
"""The 95 % quantile of a normal distribution, standard deviations. A mathematical constant."""
# Least spread of the gains under flips, in units of chi-squared, that a score is measured in.
# Chosen: far below one, what noise alone gives, and far above rounding, which is all that an effect
# of a constant condition shows.
_LEAST_SPREAD = 1e-6
# The same of what is closed by chance, m^2 over all pixels. Chosen: a micrometre in one pixel.
_LEAST_SPREAD_CLOSED = 1e-12
# What the test by likelihood has of the level; the rest is of the test by what is closed. Chosen:
# nearly all, for it is the more powerful one wherever the forms of effects are right.
_OF_LIKELIHOOD = 0.8


@dataclass(frozen=True, kw_only=True)
class EffectTest:
    """The gain by adding one effect to a model.

    Two statistics are tested. The gain in likelihood sees the smallest effects. But many pixels of
    little noise decide it inside images: an effect that mostly shifts whole images gains nothing
    if its form is a little wrong inside them. What is closed, in even squares, hardly feels that.

    Attributes:
        name: Of the effect.
        closed: Fall of the even sum of squares of each held-out pose, shape (U,), m^2.
        gain: Fall of the held-out chi-squared, over all poses.
        null: Gain by chance, shape (B,); empty where no null distribution was asked for.
        size: Number of the effect's columns or cells.
        by_tiles: Whether tiles of images were the units of `gain` and `null`.
        null_closed: Fall of the even sum of squares by chance, shape (B,), m^2; None: not drawn.
    """

    name: str
    closed: Tensor
    gain: float
    null: Tensor
    size: int
    by_tiles: bool = False
    null_closed: Tensor | None = None

    @property
    def total(self) -> float:
        """Fall of the sum of squares over all poses, m^2."""
        return float(self.closed.sum())

    @property
    def score(self) -> float:
        """Gain above the median of its null, in units of the upper half's standard deviation.

        The lower tail is not used: held-out gains have rare large losses, where an effect was
        fitted without the few poses that determine it. Median and standard deviation include the
        observed gain.
        """
        return float(self._standardised[-1])

    @property
    def p_value(self) -> float:
        """Probability of such a gain, or of closing as much, if this were the only effect tested.

        The two tests share the level (Bonferroni, weighted).
        """
        p_value = float((1 + (self.null >= self.gain).sum()) / (len(self.null) + 1))
        if self.null_closed is None:
            return p_value
        closed = self.closed_scores()
        return either(p_value, share_of(closed[:-1], closed[-1]))

    def null_scores(self, least: float = -math.inf) -> Tensor:
        """Return the scores of the draws, shape (B,); none where less is closed, m^2."""
        scores = self._standardised[:-1]
        if self.null_closed is None:
            return scores
        return torch.where(self.null_closed >= least, scores, -math.inf)

    def closed_scores(self, least: float = -math.inf) -> Tensor:
        """Return the scores of what each draw closes, then of what is closed, shape (B + 1,).

        None where less is closed, m^2, nor where it was not drawn.
        """
        if self.null_closed is None:
            return torch.full((len(self.null) + 1,), -math.inf, dtype=torch.float64)
        closed = torch.cat([self.null_closed, self.closed.sum()[None]])
        return torch.where(closed >= least, _scores(closed, _LEAST_SPREAD_CLOSED), -math.inf)

    @cached_property
    def _standardised(self) -> Tensor:
        """Scores of the draws, then that of the gain, shape (B + 1,); many rules ask for them."""
        return _scores(torch.cat([self.null, self.null.new_tensor([self.gain])]), _LEAST_SPREAD)


def _scores(values: Tensor, least_spread: float) -> Tensor:
    """Return values above their median, in standard deviations of their upper half."""
    middle, high = torch.quantile(values, values.new_tensor([0.5, 0.95]))
    return (values - middle) / ((high - middle) / NORMAL_95).clamp(min=least_spread)


def either(by_gain: float, by_closed: float) -> float:
    """Return the p-value of two tests that share a level (Bonferroni, weighted)."""
    return min(1.0, by_gain / _OF_LIKELIHOOD, by_closed / (1 - _OF_LIKELIHOOD))


def share_of(best: Tensor, score: float | Tensor) -> float:
    """Return the share of draws, (B,), that reach a score; the data count as one of them."""
    return float((1 + (best >= score).sum()) / (len(best) + 1))
