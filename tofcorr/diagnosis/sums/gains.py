r"""Held-out gains of effects as additions to one model, in the data and under sign flips.

Where all units but one fold predict that fold, with the uncertainty of the prediction included, its
chi-squared is that of all units together less that of the others (the chain rule of the normal
distribution). The fall by an effect, summed over the folds, is therefore

.. math:: \sum_f \left( s^T S^{-1} s - s_{-f}^T S_{-f}^{-1} s_{-f} \right)

with the reduced equations of all units and of those without the fold (see `elimination`). The
others cannot predict a pose that alone determines a coefficient, such as the first one of a
warm-up. Without the uncertainty, its error would outweigh the gain of all other poses. The
log-determinant is omitted, because flips do not change it.

Scores of all poses under the null hypothesis, drawn once for all models.

With the columns X of a pose, those of its uncertain offset and tilts Z, and weights w, the products

.. math:: M = \begin{pmatrix} X' w X & X' w Z \\ Z' w X & Z' w Z \end{pmatrix}
    = \begin{pmatrix} W & C' \\ C & D \end{pmatrix}

are the covariance of the scores (x, z) of independent pixel noise. The likely sums, for the
dispersion f and the uncertainty S of the poses (see `blocks`), are
A = W / f - H C / f with H = C' / f (D / f + S^-1)^-1. Scores with that covariance are

.. math:: y = x / \sqrt f - H (z / \sqrt f + e), \quad e \sim N(0, S^{-1}) ,

so one draw of (x, z, e) serves every estimate of f and S. Draws have single precision: its rounding
is far below the ridge of `_factor`.

The noise of held-out gains: Q of observed and of drawn scores (see `student_gains`).

With l_u the scores of pose u for an effect, of the residual of the larger model and beside the
smaller one, and S the normal matrix of the effect beside that model,

.. math:: Q = \sum_u l_u^T S^{-1} l_u .

The coefficients of the larger model are those of `crossval.left_out_solutions`. The equations of
the model are eliminated from them (see `elimination`), so that each effect needs small systems.

Held-out gains of effects, with a null distribution that is right for few poses.

A gain is measured in units of its own noise, as in a t-test: with l_u the scores of pose u for the
effect, of the residual of the larger model and beside the smaller one, the gain is divided by

.. math:: Q = \sum_u l_u^T S^{-1} l_u .

Its mean over all sign flips is the fall of chi-squared by chance, whatever the noise. With few
poses, or where few of them show an effect, Q is itself uncertain, and flips do not know it: on
recordings of 7 to 25 poses with nothing missing they rejected at 5 % in half of all cases. So the
null distribution of the quotient is drawn: scores of every pose are normal with the covariance A_u
that the likely sums imply (`score_draws`), and run through the same fits. Of that model only the
shape matters, as in a t-test, because the quotient has no scale (Bell and McCaffrey 2002; Cameron
and Miller 2015, "A practitioner's guide to cluster-robust inference", on few clusters).
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from tofcorr.diagnosis.sums.columns import NUM_POSE, Moments
from tofcorr.diagnosis.sums.linear_system import (
    LEFT_OUT,
    Blocks,
    Elimination,
    Sums,
    inverse_squares,
    mean_of_shares,
    solve_positive,
    sums_over,
    without_shares_of_each,
)
from tofcorr.diagnosis.sums.resampling import Folds


class FlippedGains:
    """Falls of chi-squared by one more effect, over all held-out folds.

    The flips act on the residual of the larger model. The residual of the smaller one contains the
    effect where there is one, and would widen the null distribution of a strong effect.

    Args:
        sums: Likely sums of every unit.
        chosen: Effects of the smaller model.
        folds: Which units are held out together.
        signs: Sign flips of the units, shape (B, U).
    """

    def __init__(self, sums: Sums, chosen: Sequence[str], folds: Folds, signs: Tensor) -> None:
        self._sums, self._signs = sums, signs
        inside = folds.members()
        # The last fit leaves out nothing.
        self._kept = 1 - torch.cat([inside, torch.zeros_like(inside[:1])])
        self._fits = Elimination(sums, chosen, sums_over(self._kept))
        self._each = Elimination(sums, chosen, without_shares_of_each)

    def of(self, name: str) -> Tensor:
        """Return the fall by one more effect in the data, then under every flip, shape (1 + B,)."""
        reduced = self._fits.beside(name)
        model, own = self._residual(name)
        # Of every unit and fit, (S, U, E); a flip and a fit are both sums over units.
        left = (own - model @ reduced.across) * self._kept[:, :, None]
        rights = torch.cat([reduced.right[:, :, None], left.mT @ self._signs.T], dim=2)
        falls = inverse_squares(reduced.normal, rights)
        return (falls[-1] - falls[:-1]).sum(0)

    def _residual(self, name: str) -> tuple[Tensor, Tensor]:
        """Return the scores of the larger model's residual, (U, K) and (U, E).

        Its coefficients are those of `crossval.left_out_solutions`.
        """
        each = self._each
        reduced = each.beside(name)
        theta = reduced.solution()
        base = mean_of_shares(each.solution + reduced.change(theta))
        own = mean_of_shares(theta)
        model, own = each.products(name, base[:, :, None], own[:, :, None])
        score, span = self._sums.score, slice(*self._sums.layout.effects[name])
        return score[:, each.members] - model[..., 0], score[:, span] - own[..., 0]


class HeldOutSquares:
    """Even sums of squares of a model, and what one more effect closes of them.

    Args:
        blocks: Sums of every unit.
        chosen: Effects of the model.
        folds: Which units are held out together.

    Attributes:
        squares: Of the held-out residuals of each unit, by the model alone, shape (U,), m^2.
    """

    def __init__(self, blocks: Blocks, chosen: Sequence[str], folds: Folds) -> None:
        kept, score = 1 - folds.members(), blocks.even.score
        self._blocks, self._folds = blocks, folds
        self._fits = Elimination(blocks.even, chosen, sums_over(kept))
        theta = self._fits.solution[folds.of_unit]
        self._left = score - (self._fits.rows.mT @ theta[:, :, None])[..., 0]
        twice = (score + self._left)[:, self._fits.members]
        self.squares = blocks.square - (theta * twice).sum(1) / blocks.even_scale

    def closed(self, name: str) -> Tensor:
        """Return the fall of the sum of squares of each unit by one more effect, (U,), m^2."""
        reduced, left = self._fits.beside(name), self._left
        theta = reduced.solution()
        step = reduced.change(theta)[self._folds.of_unit], theta[self._folds.of_unit]
        curved = [rows[..., 0] for rows in self._fits.products(name, *(x[..., None] for x in step))]
        slopes = left[:, self._fits.members], left[:, slice(*self._blocks.layout.effects[name])]
        step, slopes, curved = (torch.cat(pair, dim=1) for pair in (step, slopes, curved))
        return (step * (2 * slopes - curved)).sum(1) / self._blocks.even_scale

    def closed_by_chance(self, names: Sequence[str], drawn: Tensor) -> dict[str, Tensor]:
        """Return what each of some effects closes of drawn scores, over all units, (B,) each, m^2.

        Args:
            names: The effects.
            drawn: Even scores, added up over the units of each fold, shape (folds, P, B).
        """
        sums, members = self._blocks.even, self._fits.members
        drawn = drawn.double()
        others = drawn.sum(0) - drawn
        model = torch.linalg.solve(self._fits.normal, others[:, members])
        grams = torch.tensordot(self._folds.members(), sums.gram, dims=1)
        left = drawn - grams[:, :, members] @ model
        closed = {}
        for name in names:
            own = torch.arange(*sums.layout.effects[name])
            reduced, both = self._fits.beside(name), torch.cat([members, own])
            right = others[:, own] - reduced.across.mT @ others[:, members]
            theta = torch.linalg.solve(reduced.normal, right)
            step = torch.cat([-reduced.across @ theta, theta], dim=1)
            slopes = 2 * left[:, both] - grams[:, both][:, :, both] @ step
            closed[name] = (step * slopes).sum((0, 1)) / self._blocks.even_scale
        return closed


# Added to the covariance of a pose's scores, as a share of each variance: columns that one pose
# cannot distinguish leave it singular. Far above rounding, far below what a prior adds.
_RIDGE = 1e-11
# Numbers that are drawn at once, and that are kept, at most. Chosen: 16 MB and 200 MB; more than
# these are drawn again for every model.
_AT_ONCE = 4_000_000
_MOST_KEPT = 50_000_000


class ScoreDraws:
    """Draws of the scores of all poses, and of the poses' own offsets and tilts.

    Args:
        products: M of every pose, shape (U, P + 3, P + 3).
        folds: Of the poses.
        count: Number of draws B.
        seed: Of the draws.

    Attributes:
        products: See above.
        inside: Which poses each fold holds, shape (folds, U), float32.
        spans: The poses that are drawn together.
        errors: Draws of N(0, 1) for e, shape (U, 3, B), float32.
        pose: z, shape (U, 3, B), float32.
        of_folds: Sums of (x, z) over the poses of each fold, shape (folds, P + 3, B), float32.
    """

    def __init__(self, products: Tensor, folds: Folds, count: int, seed: int) -> None:
        self.products, self.inside = products, folds.members().float()
        units, size = products.shape[:2]
        step = max(1, _AT_ONCE // (size * count))
        self.spans = [slice(low, min(low + step, units)) for low in range(0, units, step)]
        generator = torch.Generator().manual_seed(seed)
        self.errors = torch.randn(units, NUM_POSE, count, generator=generator)
        self.pose = torch.empty_like(self.errors)
        self.of_folds = torch.zeros(folds.count, size, count)
        self._state = generator.get_state()
        self._kept: list[Tensor] | None = None
        kept: list[Tensor] | None = [] if units * size * count <= _MOST_KEPT else None
        for span, drawn in zip(self.spans, self.blocks(), strict=True):
            self.of_folds += torch.tensordot(self.inside[:, span], drawn, dims=1)
            self.pose[span] = drawn[:, -NUM_POSE:]
            if kept is not None:
                kept.append(drawn)
        self._kept = kept

    def blocks(self) -> Iterator[Tensor]:
        """Yield the draws (x, z) of the poses of each span, shape (U', P + 3, B), float32."""
        if self._kept is not None:
            yield from self._kept
            return
        generator = torch.Generator()
        generator.set_state(self._state)
        for span in self.spans:
            factor = _factor(self.products[span])
            yield factor @ torch.randn(len(factor), *self.of_folds.shape[1:], generator=generator)

    def added_up(self, factors: Tensor) -> Tensor:
        """Return sums of x times factors (U,) over each fold's poses, shape (folds, P, B)."""
        inside = self.inside * factors.float()
        total = torch.zeros_like(self.of_folds[:, :-NUM_POSE])
        for span, drawn in zip(self.spans, self.blocks(), strict=True):
            total += torch.tensordot(inside[:, span], drawn[:, :-NUM_POSE], dims=1)
        return total


class NullScores:
    """Draws from a normal distribution with the covariance A of the likely sums.

    Args:
        draws: For every estimate of the two others.
        pose_sd: Standard deviations of the poses' offset and tilts, shape (3,), metres.
        dispersion: The dispersion f.
    """

    def __init__(self, draws: ScoreDraws, pose_sd: Tensor, dispersion: float) -> None:
        cross = draws.products[:, -NUM_POSE:] / dispersion
        inner = cross[:, :, -NUM_POSE:] + torch.diag(pose_sd**-2)
        self._draws, self._scale, self._pose_sd = draws, dispersion**-0.5, pose_sd
        self._lift = -torch.linalg.solve(inner, cross[:, :, :-NUM_POSE]).mT.float()
        self._pose = draws.pose * self._scale + draws.errors / pose_sd.float()[:, None]

    @property
    def spans(self) -> list[slice]:
        """Which poses each of the `blocks` holds."""
        return self._draws.spans

    def of_folds(self) -> Tensor:
        """Return the sums of scores over the poses of each fold, shape (folds, P, B), float32."""
        total = self._scale * self._draws.of_folds[:, :-NUM_POSE]
        for fold, inside in zip(total, self._draws.inside, strict=True):
            own = inside.nonzero()[:, 0]
            lift, pose = self._lift[own], self._pose[own]
            fold.addmm_(lift.transpose(0, 1).flatten(1), pose.flatten(0, 1))
        return total

    def even_of_folds(self, moments: Moments, scale: float) -> Tensor:
        """Return the same draws as scores of even weights, shape (folds, P, B), float32.

        The errors of the poses are -S e. Within a pose, even weights are taken for those of the
        likely sums times a constant.

        Args:
            moments: Sums over the pixels.
            scale: What even sums are multiplied by.
        """
        first = moments.plain.shape[-1] - 1 - NUM_POSE
        ratio = moments.plain[:, first, first] / moments.weighted[:, first, first].clamp(min=1e-30)
        total = self._draws.added_up(scale / self._scale * ratio)
        across = scale * moments.plain[:, :first, first:-1].float()
        errors = -self._draws.errors * self._pose_sd.float()[:, None]
        for fold, inside in zip(total, self._draws.inside, strict=True):
            own = inside.nonzero()[:, 0]
            fold.addmm_(across[own].transpose(0, 1).flatten(1), errors[own].flatten(0, 1))
        return total

    def blocks(self) -> Iterator[Tensor]:
        """Yield the scores of the poses of each span, shape (U', P, B), float32."""
        for span, drawn in zip(self.spans, self._draws.blocks(), strict=True):
            yield torch.baddbmm(
                drawn[:, :-NUM_POSE], self._lift[span], self._pose[span], beta=self._scale
            )


def _factor(covariance: Tensor) -> Tensor:
    """Return F with F F' the covariance of each pose, shape (U, N, N), float32."""
    tiny = torch.finfo(torch.float64).tiny
    size = covariance.diagonal(dim1=1, dim2=2).clamp(min=tiny).sqrt()
    correlation = (covariance / size[:, :, None]).div_(size[:, None, :])
    correlation.diagonal(dim1=1, dim2=2).add_(_RIDGE)
    factor, failed = torch.linalg.cholesky_ex(correlation)
    if bool(failed.any()):
        values, vectors = torch.linalg.eigh(correlation)
        factor = vectors * values.clamp(min=0).sqrt()[:, None, :]
    return factor.float().mul_(size.float()[:, :, None])


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


def student_gains(
    sums: Sums,
    chosen: Sequence[str],
    names: Sequence[str],
    folds: Folds,
    null: NullScores | None = None,
) -> dict[str, Tensor]:
    """Return the fall of chi-squared by each of some effects, then its null distribution, (1 + B,).

    The null distribution is that of the quotient, times the observed Q.

    Args:
        sums: Likely sums of every pose.
        chosen: Effects of the smaller model.
        names: The effects of which one is added.
        folds: Which poses are held out together.
        null: Scores under the null hypothesis; without them only the fall itself is returned.
    """
    inside = folds.members()
    # The last fit leaves out nothing.
    kept = 1 - torch.cat([inside, torch.zeros_like(inside[:1])])
    fits = Elimination(sums, chosen, sums_over(kept))
    effects = {name: _added(name, sums, fits) for name in names}
    observed = torch.tensordot(inside, sums.score, dims=1)[:, :, None]
    gains = _falls(effects, fits.members, observed)
    if null is None:
        return gains
    of_folds = null.of_folds()
    drawn = _falls(effects, fits.members, of_folds)
    noise = gain_noise(effects, sums, fits, null, of_folds)
    return {
        name: torch.cat([gains[name], drawn[name] / noise[name][1:] * noise[name][0]])
        for name in names
    }


def _added(name: str, sums: Sums, fits: Elimination) -> Added:
    reduced = fits.beside(name)
    own = slice(*sums.layout.effects[name])
    return Added(own=own, across=reduced.across, root=_inverse_root(reduced.normal))


def _inverse_root(matrices: Tensor) -> Tensor:
    """Return R with R' R = S^-1; where rounding leaves some S singular, of the positive parts."""
    factor, failed = torch.linalg.cholesky_ex(matrices)
    if not bool(failed.any()):
        one = torch.eye(matrices.shape[-1], dtype=matrices.dtype)
        return torch.linalg.solve_triangular(factor, one, upper=False)
    values, vectors = torch.linalg.eigh(matrices)
    return torch.where(values > 0, values, torch.inf).rsqrt()[..., None] * vectors.mT


def _falls(effects: Mapping[str, Added], members: Tensor, of_folds: Tensor) -> dict[str, Tensor]:
    """Return the held-out falls of chi-squared by each effect, shape (R,), float64.

    Args:
        effects: The effects.
        members: Numbers of the model's columns.
        of_folds: Scores, added up over the poses of each fold, shape (folds, P, R).
    """
    total = of_folds.sum(0, keepdim=True)
    of_fits = torch.cat([total - of_folds, total])
    model = of_fits[:, members]
    falls = {}
    for name, effect in effects.items():
        across, root = effect.across.to(total.dtype), effect.root.to(total.dtype)
        right = torch.baddbmm(of_fits[:, effect.own], across.mT, model, alpha=-1)
        squares = (root @ right).square_().sum(1).double()
        falls[name] = (squares[-1] - squares[:-1]).sum(0)
    return falls
