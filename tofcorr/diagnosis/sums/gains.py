r"""Held-out gains of effects as additions to one model, and what chance would give.

Where all units but one fold predict that fold, with the uncertainty of the prediction included, its
chi-squared is that of all units together less that of the others (the chain rule of the normal
distribution). The fall by an effect, summed over the folds, is therefore

.. math:: \sum_f \left( s^T S^{-1} s - s_{-f}^T S_{-f}^{-1} s_{-f} \right)

with the reduced equations of all units and of those without the fold (see `Elimination`). The
others cannot predict a pose that alone determines a coefficient, such as the first one of a
warm-up. Without the uncertainty, its error would outweigh the gain of all other poses. The
log-determinant is omitted, because flips do not change it.

Where tiles are the units, signs of their residuals are flipped (`flipped_gains`). Poses are few, or
few of them show an effect, and flips do not know how uncertain the noise of a gain is then: on
recordings of 7 to 25 poses with nothing missing they rejected at 5 % in half of all cases. So a
gain of poses is measured in units of its own noise, as in a t-test (`student_gains`): with l_u the
scores of pose u for the effect, of the residual of the larger model and beside the smaller one, the
gain is divided by

.. math:: Q = \sum_u l_u^T S^{-1} l_u .

Its mean over all sign flips is the fall of chi-squared by chance, whatever the noise. The null
distribution of the quotient is drawn: scores of every pose are normal with the covariance A_u that
the generalised sums imply (`NullScores`), and run through the same fits. Of that model only the
shape matters, as in a t-test, because the quotient has no scale (Bell and McCaffrey 2002; Cameron
and Miller 2015, "A practitioner's guide to cluster-robust inference", on few clusters).
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor

from tofcorr.diagnosis.sums.elimination import (
    Elimination,
    Reduced,
    sums_over,
    without_shares_of_each,
)
from tofcorr.diagnosis.sums.linear_system import (
    LEFT_OUT,
    NUM_POSE,
    PoseSums,
    Sums,
    solver,
)
from tofcorr.diagnosis.sums.observations import TINY

# Least Q, in units of chi-squared. Chosen: an effect that the model absorbs entirely has none.
_LEAST_SCALE = 1e-9


class HeldOutSquares:
    """Sums of squares of a model, and what one more effect closes of them.

    Args:
        sums: Of every unit: ordinary ones for m^2, generalised ones for chi-squared.
        chosen: Effects of the model.
        folds: Which units each fold holds out, shape (folds, U).

    Attributes:
        squares: Of the held-out residuals of each unit, by the model alone, shape (U,).
    """

    def __init__(self, sums: Sums, chosen: Sequence[str], folds: Tensor) -> None:
        self._sums, self._folds, self._fold = sums, folds, folds.argmax(0)
        self._fits = Elimination(sums, chosen, sums_over(1 - folds))
        theta = self._fits.solution[self._fold]
        self._left = sums.score - (self._fits.rows.mT @ theta[:, :, None])[..., 0]
        twice = (sums.score + self._left)[:, self._fits.members]
        self.squares = sums.square - (theta * twice).sum(1) / sums.scale

    def closed(self, name: str) -> Tensor:
        """Return the fall of the sum of squares of each unit by one more effect, (U,)."""
        step = [each[self._fold] for each in self._fits.beside(name).solution()]
        curved = torch.cat(self._fits.products(name, *step), dim=1)
        own = torch.arange(*self._sums.layout.effects[name])
        slopes = self._left[:, torch.cat([self._fits.members, own])]
        return (torch.cat(step, dim=1) * (2 * slopes - curved)).sum(1) / self._sums.scale

    def closed_by_chance(self, names: Sequence[str], drawn: Tensor) -> dict[str, Tensor]:
        """Return what each of some effects closes of drawn scores, over all units, (B,) each.

        Args:
            names: The effects.
            drawn: Scores, added up over the units of each fold, shape (folds, P, B).
        """
        sums, members = self._sums, self._fits.members
        drawn = drawn.double()
        others = drawn.sum(0) - drawn
        model = torch.linalg.solve(self._fits.normal, others[:, members])
        grams = torch.tensordot(self._folds, sums.gram, dims=1)
        left = drawn - grams[:, :, members] @ model
        closed = {}
        for name in names:
            own = torch.arange(*sums.layout.effects[name])
            reduced, both = self._fits.beside(name), torch.cat([members, own])
            right = others[:, own] - reduced.across.mT @ others[:, members]
            theta = torch.linalg.solve(reduced.normal, right)
            step = torch.cat([-reduced.across @ theta, theta], dim=1)
            slopes = 2 * left[:, both] - grams[:, both][:, :, both] @ step
            closed[name] = (step * slopes).sum((0, 1)) / sums.scale
        return closed


def flipped_gains(
    sums: Sums, chosen: Sequence[str], names: Sequence[str], folds: Tensor, signs: Tensor
) -> dict[str, Tensor]:
    """Return the fall of chi-squared by each of some effects, then under every flip, (1 + B,).

    The flips act on the residual of the larger model. The residual of the smaller one contains the
    effect where there is one, and would widen the null distribution of a strong effect. Its
    coefficients are those of `Sums.left_out_solutions`.

    Args:
        sums: Generalised sums of every unit.
        chosen: Effects of the smaller model.
        names: The effects of which one is added.
        folds: Which units each fold holds out, shape (folds, U).
        signs: Sign flips of the units, shape (B, U).
    """
    kept = _kept(folds)
    fits = Elimination(sums, chosen, sums_over(kept))
    each = Elimination(sums, chosen, without_shares_of_each)
    gains = {}
    for name in names:
        effect, own = _added(name, sums, fits), slice(*sums.layout.effects[name])
        change, theta = each.beside(name).solution()
        solved = [
            x.unflatten(0, (len(LEFT_OUT), -1)).mean(0) for x in (each.solution + change, theta)
        ]
        of_model, of_own = each.products(name, *solved)
        model, score = sums.score[:, each.members] - of_model, sums.score[:, own] - of_own
        # Of every unit and fit, (S, U, E); a flip and a fit are both sums over units.
        left = (score - model @ effect.across) * kept[:, :, None]
        right = effect.reduced.right[:, :, None]
        gains[name] = _fall(effect.root @ torch.cat([right, left.mT @ signs.T], dim=2))
    return gains


def student_gains(
    sums: Sums,
    chosen: Sequence[str],
    names: Sequence[str],
    folds: Tensor,
    null: "NullScores | None" = None,
) -> dict[str, Tensor]:
    """Return the fall of chi-squared by each of some effects, then its null distribution, (1 + B,).

    The null distribution is that of the quotient, times the observed Q.

    Args:
        sums: Generalised sums of every pose.
        chosen: Effects of the smaller model.
        names: The effects of which one is added.
        folds: Which poses each fold holds out, shape (folds, U).
        null: Scores under the null hypothesis; without them only the fall itself is returned.
    """
    fits = Elimination(sums, chosen, sums_over(_kept(folds)))
    effects = {name: _added(name, sums, fits) for name in names}
    observed = torch.tensordot(folds, sums.score, dims=1)[:, :, None]
    gains = _falls(effects, fits.members, observed)
    if null is None:
        return gains
    of_folds = null.of_folds()
    drawn = _falls(effects, fits.members, of_folds)
    noise = _gain_noise(effects, sums, fits, null, of_folds.sum(0))
    return {
        name: torch.cat([gains[name], drawn[name] / noise[name][1:] * noise[name][0]])
        for name in names
    }


class _Added(NamedTuple):
    """An effect beside the model, in every fit; the last fit leaves out nothing.

    Attributes:
        own: The effect's columns.
        reduced: Its equations.
        root: R with R' R = S^-1, shape (S, E, E).
    """

    own: slice
    reduced: Reduced
    root: Tensor

    @property
    def across(self) -> Tensor:
        """Z, shape (S, K, E)."""
        return self.reduced.across


def _added(name: str, sums: Sums, fits: Elimination) -> _Added:
    reduced = fits.beside(name)
    return _Added(slice(*sums.layout.effects[name]), reduced, _inverse_root(reduced.normal))


def _kept(folds: Tensor) -> Tensor:
    """Return which units each fit keeps, all in the last one, shape (folds + 1, U)."""
    return 1 - torch.cat([folds, torch.zeros_like(folds[:1])])


def _inverse_root(matrices: Tensor) -> Tensor:
    """Return R with R' R = S^-1; where rounding leaves some S singular, of the positive parts."""
    factor, failed = torch.linalg.cholesky_ex(matrices)
    if not bool(failed.any()):
        one = torch.eye(matrices.shape[-1], dtype=matrices.dtype)
        return torch.linalg.solve_triangular(factor, one, upper=False)
    values, vectors = torch.linalg.eigh(matrices)
    return torch.where(values > 0, values, torch.inf).rsqrt()[..., None] * vectors.mT


def _fall(scores: Tensor) -> Tensor:
    """Return the held-out falls of chi-squared, (R,), from reduced scores times R, (S, E, R)."""
    squares = scores.square_().sum(1).double()
    return (squares[-1] - squares[:-1]).sum(0)


def _falls(effects: Mapping[str, _Added], members: Tensor, of_folds: Tensor) -> dict[str, Tensor]:
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
        falls[name] = _fall(root @ right)
    return falls


def _gain_noise(
    effects: Mapping[str, _Added],
    sums: Sums,
    fits: Elimination,
    null: "NullScores",
    total: Tensor,
) -> dict[str, Tensor]:
    """Return Q of each effect, of the observed and of the drawn scores, shape (1 + B,).

    The coefficients of the larger model are those of `Sums.left_out_solutions`. The equations of
    the model are eliminated from them, so that each effect needs small systems.

    Args:
        effects: Those of which one is added.
        sums: Generalised sums of every pose.
        fits: Of the model without them.
        null: Drawn scores.
        total: The same, added up over all poses, shape (P, B).
    """
    members, gram = fits.members, sums.gram
    shares = gram.new_tensor(LEFT_OUT)[:, None, None, None]
    whole = sums.total + sums.layout.prior
    noise = {name: [] for name in effects}
    for span, drawn in zip(null.spans, null.blocks(), strict=True):
        rows = fits.rows[span]
        # N_mm^-1, N_me and Z of the fits without the shares; the last two of all columns.
        known = whole[members] - shares * rows
        inverse = torch.linalg.inv(known[..., members])
        all_across = inverse @ known
        for name, effect in effects.items():
            own, root = effect.own, effect.root[-1]
            # Beside the model, in units of S: R (own - Z' model).
            beside = -root @ effect.across[-1].mT
            of_model = root @ rows[:, :, own].mT + beside @ rows[:, :, members]
            of_own = root @ gram[span, own, own] + beside @ rows[:, :, own]
            # Z and S of the fits without the shares, (3, U', K, E) and (3, U', E, E).
            across = all_across[..., own]
            normal = whole[own, own] - shares * gram[span, own, own] - known[..., own].mT @ across
            solved = solver(normal)((of_own - of_model @ across).mT).mT
            through = of_model @ inverse - solved @ across.mT
            # What multiplies the scores of the model and of the effect to give R l, of the pose
            # itself and of all poses together.
            maps = (
                beside + (shares * through).mean(0),
                root + (shares * solved).mean(0),
                -through.mean(0).flatten(0, 1),
                -solved.mean(0).flatten(0, 1),
            )
            pairs = (sums.score[span, :, None], sums.score.sum(0)[:, None]), (drawn, total)
            noise[name].append(torch.cat([_squares(maps, *pair, members, own) for pair in pairs]))
    return {
        name: torch.stack(parts).sum(0).clamp(min=_LEAST_SCALE) for name, parts in noise.items()
    }


def _squares(
    maps: tuple[Tensor, ...], scores: Tensor, total: Tensor, members: Tensor, own: slice
) -> Tensor:
    """Return the sum of squares of R l over some poses, shape (R,), float64.

    Args:
        maps: What multiplies scores of model and effect, of the poses (U', E, K) and (U', E, E),
            then of all poses, flattened.
        scores: Of the poses, shape (U', P, R).
        total: Of all poses, shape (P, R).
        members: Numbers of the model's columns.
        own: The effect's columns.
    """
    by_model, by_own, all_model, all_own = (part.to(scores.dtype) for part in maps)
    left = torch.baddbmm(by_model @ scores[:, members], by_own, scores[:, own]).flatten(0, 1)
    left.addmm_(all_model, total[members]).addmm_(all_own, total[own])
    return left.square_().sum(0).double()


class NullScores:
    r"""Draws of the scores of all poses if the model is complete, normal with the covariance A.

    With the columns X of a pose, those of its uncertain offset and tilts Z, and weights w, the
    products

    .. math:: M = \begin{pmatrix} X' w X & X' w Z \\ Z' w X & Z' w Z \end{pmatrix}
        = \begin{pmatrix} W & C' \\ C & D \end{pmatrix}

    are the covariance of the scores (x, z) of independent pixel noise. The generalised sums, for
    the dispersion f and the uncertainty S of the poses, are A = W / f - H C / f with
    H = C' / f (D / f + S^-1)^-1. Scores with that covariance are

    .. math:: y = x / \sqrt f - H (z / \sqrt f + e), \quad e \sim N(0, S^{-1}) .

    The same seed gives the same (x, z, e) for every estimate of f and S. Draws have single
    precision: its rounding is far below the `ridge`.

    Args:
        sums: Of the poses.
        folds: Which poses each fold holds out, shape (folds, U).
        count: Number of draws B.
        seed: Of the draws.

    Attributes:
        spans: The poses that each of the `blocks` holds.

    Class attributes:
        at_once: Numbers that are drawn at once. Chosen: 16 MB.
        ridge: Added to the covariance of a pose's scores, as a share of each variance: columns that
            one pose cannot distinguish leave it singular. Far above rounding, far below what a
            prior adds.
    """

    at_once: ClassVar[int] = 4_000_000
    ridge: ClassVar[float] = 1e-11

    def __init__(self, sums: PoseSums, folds: Tensor, count: int, seed: int) -> None:
        products = sums.weighted[:, :-1, :-1]
        units, size = products.shape[:2]
        step = max(1, self.at_once // (size * count))
        self.spans = [slice(low, min(low + step, units)) for low in range(0, units, step)]
        generator = torch.Generator().manual_seed(seed)
        self._errors = torch.randn(units, NUM_POSE, count, generator=generator)
        self._drawn = []
        for span in self.spans:
            factor = _factor(products[span], self.ridge)
            random = torch.randn(len(factor), size, count, generator=generator)
            self._drawn.append(factor @ random)
        cross = products[:, -NUM_POSE:] / sums.dispersion
        inner = cross[:, :, -NUM_POSE:] + torch.diag(sums.pose_sd**-2)
        self._sums, self._inside = sums, folds.float()
        self._scale, self._pose_sd = sums.dispersion**-0.5, sums.pose_sd.float()[:, None]
        self._lift = -torch.linalg.solve(inner, cross[:, :, :-NUM_POSE]).mT.float()
        pose = torch.cat([drawn[:, -NUM_POSE:] for drawn in self._drawn])
        self._pose = pose * self._scale + self._errors / self._pose_sd

    def of_folds(self) -> Tensor:
        """Return the sums of scores over the poses of each fold, shape (folds, P, B), float32."""
        return self._over_folds(self._scale * torch.ones(len(self._lift)), self._lift, self._pose)

    def even_of_folds(self) -> Tensor:
        """Return the same draws as scores of ordinary weights, shape (folds, P, B), float32.

        The errors of the poses are -S e. Within a pose, ordinary weights are taken for those of the
        generalised sums times a constant.
        """
        sums, first = self._sums, self._sums.num_columns
        ratio = sums.plain[:, first, first] / sums.weighted[:, first, first].clamp(min=TINY)
        across = sums.scale * sums.plain[:, :first, first:-1].float()
        factors = (sums.scale / self._scale * ratio).float()
        return self._over_folds(factors, across, -self._errors * self._pose_sd)

    def _over_folds(self, factors: Tensor, lift: Tensor, pose: Tensor) -> Tensor:
        """Return sums over each fold's poses of x times factors (U,), and of `lift` times `pose`.

        Args:
            factors: Of each pose.
            lift: Shape (U, P, 3).
            pose: Shape (U, 3, B).
        """
        inside, parts = self._inside * factors, []
        for span, drawn in zip(self.spans, self._drawn, strict=True):
            parts.append(torch.tensordot(inside[:, span], drawn[:, :-NUM_POSE], dims=1))
        total = torch.stack(parts).sum(0)
        for fold, members in zip(total, self._inside, strict=True):
            own = members.nonzero()[:, 0]
            fold.addmm_(lift[own].transpose(0, 1).flatten(1), pose[own].flatten(0, 1))
        return total

    def blocks(self) -> Iterator[Tensor]:
        """Yield the scores of the poses of each span, shape (U', P, B), float32."""
        for span, drawn in zip(self.spans, self._drawn, strict=True):
            own = drawn[:, :-NUM_POSE]
            yield torch.baddbmm(own, self._lift[span], self._pose[span], beta=self._scale)


def _factor(covariance: Tensor, ridge: float) -> Tensor:
    """Return F with F F' the covariance of each pose, shape (U, N, N), float32."""
    tiny = torch.finfo(torch.float64).tiny
    size = covariance.diagonal(dim1=1, dim2=2).clamp(min=tiny).sqrt()
    correlation = (covariance / size[:, :, None]).div_(size[:, None, :])
    correlation.diagonal(dim1=1, dim2=2).add_(ridge)
    factor, failed = torch.linalg.cholesky_ex(correlation)
    if bool(failed.any()):
        values, vectors = torch.linalg.eigh(correlation)
        factor = vectors * values.clamp(min=0).sqrt()[:, None, :]
    return factor.float().mul_(size.float()[:, :, None])
