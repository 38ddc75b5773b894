r"""The noise of held-out gains: Q of observed and of drawn scores (see `student_gains`).

With l_u the scores of pose u for an effect, of the residual of the larger model and beside the
smaller one, and S the normal matrix of the effect beside that model,

.. math:: Q = \sum_u l_u^T S^{-1} l_u .

The coefficients of the larger model are those of `crossval.left_out_solutions`. The equations of
the model are eliminated from them (see `elimination`), so that each effect needs small systems.
"""

from collections.abc import Mapping
from typing import NamedTuple

import torch
from torch import Tensor

from tofcorr.diagnosis.sums.blocks import Sums
from tofcorr.diagnosis.sums.crossval import LEFT_OUT
from tofcorr.diagnosis.sums.elimination import Elimination
from tofcorr.diagnosis.sums.positive import solve_positive
from tofcorr.diagnosis.sums.score_draws import NullScores

# Least Q, in units of chi-squared. Chosen: an effect that the model absorbs entirely has none.
_LEAST_SCALE = 1e-9


class Added(NamedTuple):
    """An effect beside the model, in every fit; the last fit leaves out nothing.

    Attributes:
        own: The effect's columns.
        across: Z, shape (S, K, E).
        root: R with R' R = S^-1, shape (S, E, E).
    """

    own: slice
    across: Tensor
    root: Tensor


def gain_noise(
    effects: Mapping[str, Added],
    sums: Sums,
    fits: Elimination,
    null: NullScores,
    of_folds: Tensor,
) -> dict[str, Tensor]:
    """Return Q of each effect, of the observed and of the drawn scores, shape (1 + B,).

    Args:
        effects: Those of which one is added.
        sums: Likely sums of every pose.
        fits: Of the model without them.
        null: Drawn scores.
        of_folds: The same, added up over the poses of each fold, shape (folds, P, B).
    """
    totals = sums.score.sum(0)[:, None], of_folds.sum(0)
    noise = {name: totals[0].new_zeros(1 + of_folds.shape[2]) for name in effects}
    for span, drawn in zip(null.spans, null.blocks(), strict=True):
        left_out = _LeftOut(sums, fits, span)
        scores = [
            _Scores(own, total, own[:, fits.members], total[fits.members])
            for own, total in zip((sums.score[span, :, None], drawn), totals, strict=True)
        ]
        for name, effect in effects.items():
            residuals = left_out.residuals(effect)
            noise[name] += torch.cat([residuals.squares(own, effect.own) for own in scores])
    return {name: squares.clamp(min=_LEAST_SCALE) for name, squares in noise.items()}


class _Scores(NamedTuple):
    """Scores of all columns and of those of the model, of some poses and of all together.

    Attributes:
        own: Shape (U', P, R).
        total: Shape (P, R).
        model: Shape (U', K, R).
        total_model: Shape (K, R).
    """

    own: Tensor
    total: Tensor
    model: Tensor
    total_model: Tensor


class _Residuals(NamedTuple):
    """What multiplies scores of the model and of an effect to give R l, in units of S.

    Attributes:
        pose: Of the pose's own scores, shapes (U', E, K) and (U', E, E).
        total: Of the scores of all poses, shapes (U', E, K) and (U', E, E).
    """

    pose: tuple[Tensor, Tensor]
    total: tuple[Tensor, Tensor]

    def squares(self, scores: _Scores, own: slice) -> Tensor:
        """Return the sum of squares of R l over some poses, shape (R,), float64."""
        kind = scores.own.dtype
        pose, total = ([part.to(kind) for part in parts] for parts in (self.pose, self.total))
        left = torch.baddbmm(pose[0] @ scores.model, pose[1], scores.own[:, own]).flatten(0, 1)
        left.addmm_(total[0].flatten(0, 1), scores.total_model, alpha=-1)
        left.addmm_(total[1].flatten(0, 1), scores.total[own], alpha=-1)
        return left.square_().sum(0).double()


class _LeftOut:
    """The fits of the larger models without a share of each of some poses.

    Args:
        sums: Likely sums of every pose.
        fits: Of the model.
        span: The poses.
    """

    def __init__(self, sums: Sums, fits: Elimination, span: slice) -> None:
        self._gram, self._rows = sums.gram[span], fits.rows[span]
        self._model = self._rows[:, :, fits.members]
        self._shares = shares = sums.gram.new_tensor(LEFT_OUT)[:, None, None, None]
        self._total = sums.total + sums.layout.prior
        # N_mm^-1, N_me and Z of the fits without the shares; the last two of all columns.
        self._known = fits.total_rows - shares * self._rows
        self._inverse = _inverse(self._known[..., fits.members])
        self._across = self._inverse @ self._known

    def residuals(self, effect: Added) -> _Residuals:
        """Return what gives the residual scores of one more effect from all scores."""
        own, shares, root = effect.own, self._shares, effect.root[-1]
        gram, rows = self._gram[:, own, own], self._rows[:, :, own]
        # Beside the model, in units of S: R (own - Z' model).
        beside = -root @ effect.across[-1].mT
        of_model = root @ rows.mT + beside @ self._model
        of_own = root @ gram + beside @ rows
        # Z and S of the fits without the shares, (3, U', K, E) and (3, U', E, E).
        across = self._across[..., own]
        normal = self._total[own, own] - shares * gram - self._known[..., own].mT @ across
        solved = solve_positive(normal, (of_own - of_model @ across).mT).mT
        through = of_model @ self._inverse - solved @ across.mT
        return _Residuals(
            pose=(beside + (shares * through).mean(0), root + (shares * solved).mean(0)),
            total=(through.mean(0), solved.mean(0)),
        )


def _inverse(matrices: Tensor) -> Tensor:
    one = torch.eye(matrices.shape[-1], dtype=matrices.dtype)
    return solve_positive(matrices, one.expand_as(matrices))
