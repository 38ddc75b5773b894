r"""Held-out gains of effects as additions to one model, and what chance would give.

Where all units but one fold predict that fold, with the uncertainty of the prediction included, its
chi-squared is that of all units together less that of the others (the chain rule of the normal
distribution). The fall by an effect, summed over the folds, is therefore

.. math:: \sum_f \left( s^T S^{-1} s - s_{-f}^T S_{-f}^{-1} s_{-f} \right)

with the equations of the effect, reduced by the model's, of all units and of those without the
fold: for columns m of the model and e of the effect, and the equations N theta = b, they are

.. math:: S = N_{ee} - N_{em} N_{mm}^{-1} N_{me}, \quad s = b_e - N_{em} N_{mm}^{-1} b_m .

The others cannot predict a pose that alone determines a coefficient, such as the first one of a
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

An effect that has one value for each cell of the image (`FittedMap`) is no column. With the
residual r, less the offset and tilts of its pose, and the weights w of the pixels of a cell c, the
value is

.. math:: v_c = \frac{\sum w r}{\sum w + s^{-2}} ,

with the prior standard deviation s, which is no less than what poses agree in. The weights are
those of the pixels' own noise. The dispersion says how much more sums over many pixels vary than
independent noise would make them, where neighbours share noise or show a smooth pattern; a cell is
no such sum.
"""

from collections.abc import Sequence
from functools import cached_property
from itertools import product

import torch
from torch import Tensor

from tofcorr.diagnosis.sums.linear_system import LEFT_OUT, NUM_POSE, PoseSums, Sums
from tofcorr.diagnosis.sums.observations import TINY
from tofcorr.diagnosis.sums.study import Study
from tofcorr.simulation.effects import MapEffect

# Added to a matrix before it is factored, as a share of its diagonal: rounding of sums of products
# leaves less. And to the covariance of a pose's scores, which columns that one pose cannot
# distinguish leave singular: far above rounding, far below what a prior adds.
_ROUNDING, _RIDGE = 1e-12, 1e-11


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
        self._sums, self._chosen, self._folds = sums, chosen, folds
        self.squares = self._squares(chosen)

    def _squares(self, names: Sequence[str]) -> Tensor:
        """Return the squares of each held-out unit, by the model of some effects, (U,)."""
        gram, score, prior = self._sums.of(names)
        theta = self._fitted(gram, prior, self._folds @ score)[1][self._folds.argmax(0)]
        curved = (gram @ theta[:, :, None])[..., 0]
        return self._sums.square - (theta * (2 * score - curved)).sum(1) / self._sums.scale

    def _fitted(self, gram: Tensor, prior: Tensor, right: Tensor) -> tuple[Tensor, Tensor]:
        """Return A over each fold (folds, K, K), and the others' fit to scores (folds, K, ...)."""
        own = torch.tensordot(self._folds, gram, dims=1)
        return own, torch.linalg.solve(own.sum(0) + prior - own, right.sum(0) - right)

    def closed(self, name: str) -> Tensor:
        """Return the fall of the sum of squares of each unit by one more effect, (U,)."""
        return self.squares - self._squares([*self._chosen, name])

    def closed_by_chance(self, names: Sequence[str], drawn: Tensor) -> dict[str, Tensor]:
        """Return what each of some effects closes of drawn scores, over all units, (B,) each.

        Args:
            names: The effects.
            drawn: Scores, added up over the units of each fold, shape (folds, P, B).
        """

        def explained(names: Sequence[str]) -> Tensor:
            """Return the fall of the sum of squares by a whole model, (B,)."""
            gram, _, prior = self._sums.of(names)
            right = drawn[:, self._sums.layout.of(names)].double()
            own, theta = self._fitted(gram, prior, right)
            return (theta * (2 * right - own @ theta)).sum((0, 1)) / self._sums.scale

        model = explained(self._chosen)
        return {name: explained([*self._chosen, name]) - model for name in names}


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
    gains = {}
    for name in names:
        larger, size = [*chosen, name], len(range(*sums.layout.effects[name]))
        gram, score, prior = sums.of(larger)
        left = score - (gram @ sums.left_out_solutions(larger)[:, :, None])[..., 0]
        # A flip and a fold are both sums over units.
        flipped = (left * folds[:, :, None]).mT @ signs.T
        right = torch.cat([(folds @ score)[:, :, None], flipped], dim=2)
        gains[name] = _fall(gram, prior, size, folds, right)
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
    gains = {}
    for name in names:
        larger, size = [*chosen, name], len(range(*sums.layout.effects[name]))
        gram, score, prior = sums.of(larger)
        if null is None:
            gains[name] = _fall(gram, prior, size, folds, (folds @ score)[:, :, None])
            continue
        drawn = null.scores[:, sums.layout.of(larger)].double()
        scores = torch.cat([score[:, :, None], drawn], dim=2)
        fall = _fall(gram, prior, size, folds, torch.tensordot(folds, scores, dims=1))
        noise = _gain_noise(gram, prior, size, scores)
        gains[name] = fall / noise * noise[0]
    return gains


def _fall(gram: Tensor, prior: Tensor, size: int, folds: Tensor, right: Tensor) -> Tensor:
    """Return the held-out falls of chi-squared by the last effect of a model, (R,).

    Args:
        gram: A of the model's columns, those of the effect last, shape (U, K, K).
        prior: Prior precision, shape (K, K).
        size: Number of columns of the effect, E.
        folds: Which units each fold holds out, shape (folds, U).
        right: Scores of the columns over each fold, shape (folds, K, R).
    """
    own, whole = torch.tensordot(folds, gram, dims=1), gram.sum(0)
    normal = torch.cat([whole - own, whole[None]]) + prior
    total = right.sum(0, keepdim=True)
    squares = _reduced(normal, torch.cat([total - right, total]), size).square().sum(1)
    return (squares[-1] - squares[:-1]).sum(0)


def _reduced(normal: Tensor, right: Tensor, size: int) -> Tensor:
    """Return R s of the last columns, with R' R = S^-1, shape (..., E, B).

    With the factor N = L L', they are the last rows of L^-1 b.

    Args:
        normal: N, shape (..., K, K).
        right: Scores b, shape (..., K, B).
        size: How many columns, E.
    """
    ridge = _ROUNDING * normal.diagonal(dim1=-2, dim2=-1) + TINY
    factor = torch.linalg.cholesky(normal + ridge.diag_embed())
    return torch.linalg.solve_triangular(factor, right, upper=False)[..., -size:, :]


def _gain_noise(gram: Tensor, prior: Tensor, size: int, scores: Tensor) -> Tensor:
    """Return Q of the last effect of a model, for scores of every pose (U, K, R), shape (R,).

    The coefficients of the larger model are those of `Sums.left_out_solutions`; the other arguments
    are those of `_fall`.
    """
    whole = gram.sum(0) + prior
    beside = _reduced(whole, torch.eye(len(whole), dtype=whole.dtype), size)
    # What gives R l from the scores of the pose itself, and from those of all poses together.
    shares = whole.new_tensor(LEFT_OUT)[:, None, None, None]
    without = torch.linalg.solve(whole - shares * gram, (beside @ gram).mT[None]).mT
    of_pose, of_all = beside + (shares * without).mean(0), without.mean(0)
    left = of_pose @ scores - of_all @ scores.sum(0)
    # An effect that the model absorbs entirely has none, in units of chi-squared.
    return left.square().sum((0, 1)).clamp(min=1e-9)


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
    precision: its rounding is far below the ridge.

    Args:
        sums: Of the poses.
        folds: Which poses each fold holds out, shape (folds, U).
        count: Number of draws B.
        seed: Of the draws.
    """

    def __init__(self, sums: PoseSums, folds: Tensor, count: int, seed: int) -> None:
        products = sums.weighted[:, :-1, :-1]
        generator = torch.Generator().manual_seed(seed)
        self._errors = torch.randn(len(products), NUM_POSE, count, generator=generator)
        random = torch.randn(*products.shape[:2], count, generator=generator)
        self._sums, self._folds, self._drawn = sums, folds.float(), _factor(products) @ random

    @cached_property
    def scores(self) -> Tensor:
        """The scores y of each pose, shape (U, P, B), float32."""
        sums, scale = self._sums, self._sums.dispersion**-0.5
        cross = sums.weighted[:, -NUM_POSE - 1 : -1, :-1] / sums.dispersion
        inner = cross[:, :, -NUM_POSE:] + torch.diag(sums.pose_sd**-2)
        lift = -torch.linalg.solve(inner, cross[:, :, :-NUM_POSE]).mT.float()
        own, pose = self._drawn[:, :-NUM_POSE], self._drawn[:, -NUM_POSE:]
        pose = pose * scale + self._errors / sums.pose_sd.float()[:, None]
        return torch.baddbmm(own, lift, pose, beta=scale)

    def even_of_folds(self) -> Tensor:
        """Return the same draws with ordinary weights, over each fold, (folds, P, B), float32.

        The errors of the poses are -S e. Within a pose, ordinary weights are taken for those of the
        generalised sums times a constant.
        """
        sums, first = self._sums, self._sums.num_columns
        ratio = sums.plain[:, first, first] / sums.weighted[:, first, first].clamp(min=TINY)
        factors = (sums.scale * sums.dispersion**0.5 * ratio).float()[:, None, None]
        across = sums.scale * sums.plain[:, :first, first:-1].float()
        errors = -self._errors * sums.pose_sd.float()[:, None]
        even = torch.baddbmm(self._drawn[:, :-NUM_POSE] * factors, across, errors)
        return torch.tensordot(self._folds, even, dims=1)


def _factor(covariance: Tensor) -> Tensor:
    """Return F with F F' the covariance of each pose, shape (U, N, N), float32."""
    size = covariance.diagonal(dim1=1, dim2=2).clamp(min=torch.finfo(torch.float64).tiny).sqrt()
    correlation = covariance / (size[:, :, None] * size[:, None, :])
    correlation.diagonal(dim1=1, dim2=2).add_(_RIDGE)
    factor, failed = torch.linalg.cholesky_ex(correlation)
    if bool(failed.any()):
        values, vectors = torch.linalg.eigh(correlation)
        factor = vectors * values.clamp(min=0).sqrt()[:, None, :]
    return factor.float() * size.float()[:, :, None]


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
        """Return the values of right sides (cells, R)."""
        prior = self.prior_sd**-2
        if system.ndim == 1:
            return right / (system + prior)[:, None]
        return torch.linalg.solve(system + prior * torch.eye(len(system)).double(), right)

    def _without_folds(self, sums: Tensor) -> list[Tensor]:
        """Return what every pose adds to the map without each fold, shape (cells, U) each."""
        systems, kept = self._systems, 1 - self._study.folds
        whole = systems.sum(0)
        pairs = zip(systems, kept, strict=True)
        return [self._solved(whole - own, (sums * inside[:, None]).T) for own, inside in pairs]

    def whole(self) -> Tensor:
        """Return the map's values estimated from all poses, shape (cells,), metres."""
        found = self._solved(self._systems.sum(0), self._sums.sum(0)[:, None])[:, 0]
        every = torch.zeros(len(self._effect.coefficients), dtype=torch.float64)
        return every.index_copy(0, self._used, found)

    @cached_property
    def values(self) -> Tensor:
        """The map's value in every pixel, estimated without the pixel's fold, (M,), metres."""
        of_folds = torch.stack([own.sum(1) for own in self._without_folds(self._sums)])
        return of_folds[self._fold[:, None], self._cells].sum(-1)

    def gain(self) -> Tensor:
        """Return the fall of chi-squared of each held-out pose, shape (U,)."""
        gain = self._study.weight * (2 * self._observed * self.values - self.values**2)
        zeros = torch.zeros(self._study.sums.num_units, dtype=torch.float64)
        return zeros.index_add(0, self._study.unit_of_pixel, gain)

    def null(self, left_out: Tensor) -> Tensor:
        """Return the total gain under every sign flip, shape (B,).

        The gain is a quadratic form of the signs, so that one matrix (U, U) serves all flips.

        Args:
            left_out: The residual with every pose left out of its own fit, shape (M,), metres.
        """
        study = self._study
        # What the map explains would widen the null distribution of a strong one.
        unexplained = _without_pose(study, left_out) - self.values
        sums = self._per_pose(self._cells, study.fit.weight * unexplained)
        form = torch.zeros(len(sums), len(sums), dtype=torch.float64)
        for fold, values in enumerate(self._without_folds(sums)):
            system = self._systems[fold]
            curved = system[:, None] * values if system.ndim == 1 else system @ values
            form.addmm_(values.T, 2 * (sums * study.folds[fold][:, None]).T - curved)
        return ((study.signs @ form) * study.signs).sum(1) / study.sums.dispersion


def _without_pose(study: Study, residual: Tensor) -> Tensor:
    """Subtract the most probable offset and tilts of each pose, shape (M,)."""
    inner, score = study.pose_equations(residual)
    guess = torch.linalg.solve(inner + torch.diag(study.sums.pose_sd**-2), score)
    return residual - study.pose_surface(guess)
