"""Tests of all effects side by side, as additions to one model, and which of them are alike.

Each is tested by the units that suit it: what it gains, and what chance would.

A catalogue holds some forms of an effect, and a camera or a room has its own. If an effect is the
cause of C, its columns explain at least C / (1 + e^2), where e is its `form_error`. The rest is
left, looks like scatter of the poses, or is named as another effect. So two findings follow:

- An effect that closes less than the named one, by no more than is left or taken for scatter of
  the poses, is not excluded (`cause_set`).
- Nor is one that closes, in the place of several that are named, not significantly less of what
  they close together than the cause of it would (`one_cause`).

Neither is said of an effect that fits worse than such an error explains (`fits_too_badly`).
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import torch
from scipy import special
from torch import Tensor

from tofcorr.diagnosis.sums.gains import (
    FittedMap,
    HeldOutSquares,
    NullScores,
    flipped_gains,
    student_gains,
)
from tofcorr.diagnosis.sums.linear_system import NUM_POSE, Sums, tile_sums
from tofcorr.diagnosis.sums.noise import FLOOR_ERROR
from tofcorr.diagnosis.sums.observations import TINY
from tofcorr.diagnosis.sums.study import Study
from tofcorr.estimation.robust import student_quantile
from tofcorr.simulation.effects import CATALOGUE
from tofcorr.simulation.effects.inputs import VELOCITY
from tofcorr.simulation.effects.numerics import by_frame

NORMAL_95 = float(special.ndtri(0.95))
"""The 95 % quantile of a normal distribution, standard deviations. A mathematical constant."""


@dataclass(frozen=True, kw_only=True)
class EffectTest:
    """The gain by adding one effect to a model.

    Two statistics are tested. The gain in likelihood sees the smallest effects. But many pixels of
    little noise decide it inside images: an effect that mostly shifts whole images gains nothing
    if its form is a little wrong inside them. What is closed, in ordinary squares, hardly
    feels that.

    Class attributes:
        least_spread: Least spread of the gains under flips, in units of chi-squared, that a score
            is measured in. Chosen: far below one, what noise alone gives, and far above rounding,
            which is all that an effect of a constant condition shows.
        least_spread_closed: The same of what is closed by chance, m^2 over all pixels. Chosen: a
            micrometre in one pixel.

    Attributes:
        name: Of the effect.
        closed: Fall of the ordinary sum of squares of each held-out pose, shape (U,), m^2.
        gain: Fall of the held-out chi-squared, over all poses.
        null: Gain by chance, shape (B,); empty where no null distribution was asked for.
        size: Number of the effect's columns or cells.
        by_tiles: Whether tiles of images were the units of `gain` and `null`.
        null_closed: The same by chance, over all poses, shape (B,), m^2; None: not drawn.
    """

    least_spread: ClassVar[float] = 1e-6
    least_spread_closed: ClassVar[float] = 1e-12

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
        return float(self.scores[-1])

    @property
    def spread(self) -> float:
        """Standard deviation of the upper half of the null distribution."""
        return float(_middle_and_spread(self.null)[1])

    @property
    def p_value(self) -> float:
        """Probability of such a gain, or of closing as much, if this were the only effect tested.

        The two tests share the level (Bonferroni, weighted).
        """
        p_value, closed = share_of(self.null, self.gain), self.closed_scores
        return p_value if closed is None else either(p_value, share_of(closed[:-1], closed[-1]))

    @cached_property
    def scores(self) -> Tensor:
        """Scores of the draws, then that of the gain, shape (B + 1,)."""
        return _scores(self.null, self.null.new_tensor(self.gain), self.least_spread)

    @cached_property
    def closed_scores(self) -> Tensor | None:
        """Scores of what each draw closes, then of what is closed, (B + 1,); None: not drawn."""
        if self.null_closed is None:
            return None
        return _scores(self.null_closed, self.closed.sum(), self.least_spread_closed)

    def among(self, scores: Tensor, least: float) -> Tensor:
        """Return the scores of draws, shape (B,); -inf where less than this is closed, m^2."""
        if self.null_closed is None:
            return scores[:-1]
        return torch.where(self.null_closed >= least, scores[:-1], -math.inf)


def _scores(draws: Tensor, value: Tensor, least_spread: float) -> Tensor:
    """Return draws, then a value, above their median in units of their spread, shape (B + 1,)."""
    values = torch.cat([draws, value[None]])
    middle, spread = _middle_and_spread(values)
    return (values - middle) / spread.clamp(min=least_spread)


def _middle_and_spread(values: Tensor, high: float = 0.95) -> tuple[Tensor, Tensor]:
    """Return the median, and the standard deviation of normal values with this high quantile."""
    middle, end = torch.quantile(values, values.new_tensor([0.5, high]))
    return middle, (end - middle) / float(special.ndtri(high))


def either(by_gain: float, by_closed: float, share: float = 0.8) -> float:
    """Return the p-value of two tests that share a level (Bonferroni, weighted).

    Args:
        by_gain: That of the test by likelihood.
        by_closed: That of the test by what is closed.
        share: What the first has of the level. Chosen: nearly all, for it is the more powerful one
            wherever the forms of effects are right.
    """
    return min(1.0, by_gain / share, by_closed / (1 - share))


def share_of(best: Tensor, score: float | Tensor) -> float:
    """Return the share of draws, (B,), that reach a score; the data count as one of them."""
    return float((1 + (best >= score).sum()) / (len(best) + 1))


@dataclass(frozen=True, kw_only=True)
class EffectComparison:
    """All effects side by side, as additions to one model.

    Attributes:
        chosen: Effects of the model.
        squares: Ordinary sum of squares of each held-out pose, of the model alone, shape (U,), m^2.
        tests: Of the effects, by name.
        probes: Of the probes, by name.
        least: What an effect must close over all poses to be named, m^2.
    """

    chosen: tuple[str, ...]
    squares: Tensor
    tests: dict[str, EffectTest]
    probes: dict[str, EffectTest]
    least: float = -math.inf

    def family_p_value(self, name: str) -> float:
        """Return the share of draws whose best effect scores at least as high as this one.

        A probe is compared with the best of all effects and probes.
        """
        family = self.tests | self.probes if name in self.probes else self.tests
        best = torch.stack([one.scores[:-1] for one in family.values()]).amax(0)
        return share_of(best, family[name].score)

    def naming_p_value(self, name: str) -> float:
        """Return the probability that chance would name an effect with at least this score.

        It is compared with the best of those effects that close enough in a draw. An effect that
        does not close enough itself is compared with all. It must be significant alone as well.
        The score of what is closed is compared in the same way, and the two tests share the level.
        """
        test = self.tests[name]
        if test.total < self.least:
            return self.family_p_value(name)
        p_value = share_of(self._best_named(), test.score)
        drawn = [(one, one.closed_scores) for one in self.tests.values()]
        closed = [one.among(own, self.least) for one, own in drawn if own is not None]
        if closed:
            own = -math.inf if test.closed_scores is None else float(test.closed_scores[-1])
            p_value = either(p_value, share_of(torch.stack(closed).amax(0), own))
        return max(p_value, test.p_value)

    def _best_named(self) -> Tensor:
        """Return the highest score of every draw among effects that close enough, shape (B,)."""
        return torch.stack([t.among(t.scores, self.least) for t in self.tests.values()]).amax(0)

    def ordered(self) -> list[EffectTest]:
        """Return the tests of effects in descending order of what they close."""
        return sorted(self.tests.values(), key=lambda test: -test.total)

    def critical_score(self, level: float) -> float:
        """Return the score that an effect that could be named exceeds by chance at this level.

        It is at least that of an effect which is significant by itself.
        """
        best = self._best_named().clamp(min=float(special.ndtri(1 - level)))
        return float(torch.quantile(best, 1 - level))


def compare_effects(
    study: Study,
    chosen: Sequence[str],
    *,
    flips: bool = True,
    maps: bool = True,
    seed_of_draws: int = 4,
) -> EffectComparison:
    """Test every effect that is not in the model as an addition to it.

    Poses are the units of the tests; tiles of images for effects that few images show.

    Args:
        study: The recording.
        chosen: Effects of the model, all with columns.
        flips: Whether to draw the null distributions; without them tests have no p-value. What is
            closed by chance is drawn for additions to the base model only.
        maps: Whether to test effects with one value a cell of the image.
        seed_of_draws: Added to the diagnosis' seed for the draws of null distributions; others add
            1 to 3.
    """
    sums, candidates, tiles = study.sums, study.candidates, study.tiles
    squares = HeldOutSquares(sums.ols, chosen, study.folds)
    sizes = {n: high - low for n, (low, high) in sums.layout.effects.items() if n not in chosen}
    few = list(filter(candidates.is_tested_by_tiles, sizes))
    most = [name for name in sizes if name not in few]
    null, by_chance = None, {}
    if flips:
        null = NullScores(sums, study.folds, len(study.signs), study.options.seed + seed_of_draws)
        if not chosen:
            by_chance = squares.closed_by_chance(most, null.even_of_folds())
    gains = student_gains(sums.gls, chosen, most, study.folds, null)
    closed = {name: squares.closed(name) for name in most}
    if few and tiles is not None:
        own = tile_sums(study.system, [*chosen, *few], tiles, study.fit)
        of_tiles = HeldOutSquares(own.ols, chosen, tiles.folds)
        closed |= {name: tiles.per_pose(of_tiles.closed(name), sums.num_units) for name in few}
        gains |= dict.fromkeys(few, torch.full((1,), torch.nan, dtype=torch.float64))
        if flips:
            gains |= flipped_gains(own.gls, chosen, few, tiles.folds, tiles.signs)
    if maps and candidates.maps:
        # The bend that an ordinary fit leaves in every image would pass for a map.
        residual = study.system.residual_of(chosen, gls=True)
        left_out = left_out_residual(study, chosen, sums.gls) if flips else None
        for name, effect in candidates.maps.items():
            fitted = FittedMap(study, effect, residual)
            closed[name] = squares.squares - _squares_without(study, chosen, fitted.values)
            null = [] if left_out is None else [fitted.null(left_out)]
            gains[name] = torch.cat([fitted.gain().sum()[None], *null])
            sizes[name] = len(effect.coefficients)
    tests = {
        name: EffectTest(
            name=name,
            closed=closed[name],
            gain=float(gains[name][0]),
            null=gains[name][1:],
            null_closed=by_chance.get(name),
            size=size,
            by_tiles=name in few,
        )
        for name, size in sizes.items()
    }
    least = (study.material_mm / 1000) ** 2 * float(sums.count.sum())
    return EffectComparison(
        chosen=tuple(chosen),
        squares=squares.squares,
        tests={name: test for name, test in tests.items() if name not in candidates.probes},
        probes={name: test for name, test in tests.items() if name in candidates.probes},
        least=-math.inf if chosen else least,
    )


def _squares_without(study: Study, chosen: Sequence[str], values: Tensor) -> Tensor:
    """Return the ordinary sum of squares of each held-out pose once a map is subtracted, (U,), m^2.

    The model is fitted again, as it is beside any other effect: without the map its errors bent it.
    """
    share, left, ols = study.fit.share, study.system.residual - values, study.sums.ols
    weighted = (ols.scale * share * left)[:, None]
    products = study.observations.products
    sums = replace(
        ols,
        gram=ols.of(chosen)[0],
        score=torch.cat([products(x, weighted)[..., 0] for x in study.system.of(chosen)], dim=1),
        square=torch.zeros_like(ols.square).index_add(0, study.unit_of_pixel, share * left**2),
        layout=ols.layout.only(chosen),
    )
    return HeldOutSquares(sums, chosen, study.folds).squares


def left_out_residual(study: Study, chosen: Sequence[str], sums: Sums) -> Tensor:
    """Return residuals with the variance of the errors, shape (M,), metres.

    Args:
        study: The recording.
        chosen: Effects of the model.
        sums: Ordinary or generalised sums of every pose, by which the model is fitted.
    """
    parts, left = study.system.of(chosen), study.system.residual
    theta = sums.left_out_solutions(chosen)[study.observations.unit][:, :, None]
    of_parts = theta.split([part.shape[1] for part in parts], dim=1)
    for part, own in zip(parts, of_parts, strict=True):
        left = left - by_frame(part, own, study.observations.frame)[:, 0]
    return left


def held_out_squares(study: Study, chosen: Sequence[str]) -> Tensor:
    """Return the sum of squared held-out residuals of each pose, shape (U,), m^2.

    Args:
        study: The recording.
        chosen: Effects of the model, all with columns.
    """
    return HeldOutSquares(study.sums.ols, chosen, study.folds).squares


def closed_square(study: Study, test: EffectTest) -> float:
    """Return the fall of the held-out mean square by an effect, m^2."""
    return test.total / float(study.sums.count.sum())


def least_p_value(study: Study, comparison: EffectComparison, *, probes: bool = True) -> float:
    """Return the smallest p-value of all effects and probes that close `material_mm`; 1 if none.

    Significant but tiny effects are not counted.
    """
    least, found = (study.material_mm / 1000) ** 2, [1.0]
    for p_value, tests in (
        (comparison.naming_p_value, comparison.tests),
        (comparison.family_p_value, comparison.probes if probes else {}),
    ):
        found += [p_value(one.name) for one in tests.values() if closed_square(study, one) >= least]
    return min(found)


def closed_gap(study: Study, first: EffectComparison, test: EffectTest) -> tuple[float, float]:
    """Return by how much an effect lowers the gap, metres, and its share of the squared gap.

    Args:
        study: The recording, before any effect was named.
        first: All effects as additions to the base model.
        test: Of the effect; where it makes predictions worse, the first number is negative.
    """
    total = float(first.squares.sum() / study.sums.count.sum())
    before, closed = max(total - study.fit.floor**2, 0.0), closed_square(study, test)
    share = min(max(closed / before, 0.0), 1.0) if before > 0 else 0.0
    return before**0.5 - max(before - closed, 0.0) ** 0.5, share


def cause_set(
    comparison: EffectComparison,
    winner: str,
    level: float,
    share: float,
    missed: float = 0.0,
    unexplained: float = 0.0,
    gains: Callable[[str], Tensor] | None = None,
) -> list[str]:
    """Return the effects that these data cannot distinguish from the winner, itself first.

    An effect belongs to the set if it closes more than half of what the winner closes and not
    significantly less (a t-test, paired over poses) or at least `share` of it. So does one that
    closes two thirds of it, and less by no more than the form of an effect may miss: multipath by a
    renderer closed nine tenths. Where the winner explains less than half of what there is, its form
    says little of the cause: then less than two thirds are enough, in proportion. So does an effect
    that is at least as likely: what an effect closes is uncertain where poses scatter and are few,
    and the likelihood knows how much.

    Whatever it closes, an effect does not belong to the set if it gains significantly less in
    likelihood than any error in its form explains (`fits_too_badly`).

    Args:
        comparison: All effects.
        winner: The effect or probe that is compared.
        level: Of the t-test.
        share: See above.
        missed: Sum of squares that the form of an effect may miss, m^2.
        unexplained: Sum of squares that stays unexplained, m^2.
        gains: Falls of chi-squared of each pose by an effect, shape (U,); None: not asked for.
    """
    best = comparison.probes.get(winner) or comparison.tests[winner]
    explained = best.total / max(best.total + unexplained, TINY)
    least = max(best.total - missed, 2 / 3 * min(explained / 0.5, 1.0) * best.total)

    def belongs(test: EffectTest) -> bool:
        """Return whether an effect may be the cause in the place of the winner."""
        if test.gain >= best.gain and not best.by_tiles:
            return True
        alike = test.total >= least
        if not alike and test.total > 0.5 * best.total:
            alike = test.total >= share * best.total
            alike = alike or not_significantly_less(test.closed, best.closed, level)
        if not alike or gains is None or not comparable(test, best):
            return alike
        return not fits_too_badly(test, gains(test.name), gains(winner), level)

    others = (test for test in comparison.ordered() if test.name != winner)
    return [winner, *(test.name for test in others if belongs(test))]


def comparable(test: EffectTest, *named: EffectTest) -> bool:
    """Return whether the likelihood of poses can say that a cause is not this effect.

    It cannot where what is named has more columns: they also fit what the form of a simpler cause
    misses. On a simulated recording `multipath` fitted a clear layer, which is another form of
    `incidence_angle`, better than that effect's two columns did. Nor can it of effects that are
    tested by tiles, or that have one value a cell.

    Args:
        test: The effect.
        named: What is named in its place.
    """
    form = all(CATALOGUE[one.name].form_error > 0 and not one.by_tiles for one in (test, *named))
    return form and sum(one.size for one in named) <= test.size


def fits_too_badly(test: EffectTest, gains: Tensor, of_cause: Tensor, level: float) -> bool:
    """Return whether an effect gains significantly less than if it were the cause of a gap.

    Of what the cause explains, the columns of an effect of that kind explain at least
    1 / (1 + e^2), with e its `form_error`. That holds for chi-squared as for millimetres, and the
    cause explains no less than what is named.

    Args:
        test: The effect.
        gains: Fall of chi-squared of each pose by it, shape (U,).
        of_cause: By what is named, shape (U,).
        level: Of the t-test, paired over poses.
    """
    most = (1 + CATALOGUE[test.name].form_error ** 2) * gains
    return not not_significantly_less(most, of_cause, level)


def not_significantly_less(closed: Tensor, other: Tensor, level: float) -> bool:
    """Return whether one sum over poses is not significantly less than another.

    Args:
        closed: Of every pose, shape (U,).
        other: What it is compared with, shape (U,).
        level: Of the t-test, paired over poses.
    """
    less = other - closed
    error = float(less.std()) / len(less) ** 0.5
    return float(less.mean()) <= student_quantile(1 - level, len(less) - 1) * max(error, TINY)


def one_cause(
    comparison: EffectComparison,
    together: Tensor,
    level: float,
    excluded: Callable[[EffectTest], bool] = lambda _: False,
) -> list[str]:
    """Return the effects of which several named ones may be parts.

    Args:
        comparison: Effects as additions to the model without the parts.
        together: What the parts close of every pose in that place, shape (U,), m^2.
        level: Of the test whether an effect closes less than the cause would.
        excluded: Whether an effect fits too badly for that.
    """
    found = []
    for test in comparison.ordered():
        error = CATALOGUE[test.name].form_error
        most = (1 + error**2) * test.closed
        large = error > 0 and float(most.sum()) > 0.5 * float(together.sum())
        if large and not_significantly_less(most, together, level) and not excluded(test):
            found.append(test.name)
    return found


def vary_alike(name: str, other: str) -> bool:
    """Return whether two effects both shift whole images or not, and follow the velocity or not.

    An error that is the same in all pixels of a frame is no form of one that is not, nor the other
    way round, unless that one displaces camera or target, which mostly shifts whole images.
    """
    one, two = CATALOGUE[name], CATALOGUE[other]
    moved = (one.of_frame and two.moves_images) or (two.of_frame and one.moves_images)
    alike = moved or one.of_frame == two.of_frame
    return alike and (VELOCITY in one.needs) == (VELOCITY in two.needs)


def unexplained_squares(
    study: Study, comparison: EffectComparison, *, at_least: bool = False
) -> float:
    """Return the sum of squares that a model leaves beside noise and pose scatter, m^2.

    Args:
        study: The recording.
        comparison: What could be added to the model.
        at_least: Whether the noise counts as large as it may be, so that it is no form error.
    """
    most = (1 + FLOOR_ERROR) * study.fit.noise.most if at_least else 1.0
    noise = float(study.sums.count.sum()) * (most * study.fit.floor) ** 2
    return max(float(comparison.squares.sum()) - noise - pose_scatter_squares(study), 0.0)


def pose_scatter_squares(study: Study) -> float:
    """Return the sum of squares that a model takes for scatter of the poses, m^2."""
    columns = study.sums.plain.diagonal(dim1=1, dim2=2)[:, -1 - NUM_POSE : -1].sum(0)
    return float((study.sums.pose_sd**2 * columns).sum())
