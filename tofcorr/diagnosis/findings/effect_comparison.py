"""Tests of all effects side by side, as additions to one model.

Each is tested by the units that suit it: what it gains, and what chance would.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import torch
from torch import Tensor

from tofcorr.diagnosis.sums.gains import (
    HeldOutSquares,
    NullScores,
    flipped_gains,
    student_gains,
)
from tofcorr.diagnosis.sums.linear_system import Sums, tile_sums
from tofcorr.diagnosis.sums.map_gain import map_gain
from tofcorr.diagnosis.sums.study import Study
from tofcorr.simulation.effects.numerics import by_frame

NORMAL_95 = 1.6449
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
        return torch.where(closed >= least, _scores(closed, self.least_spread_closed), -math.inf)

    @cached_property
    def _standardised(self) -> Tensor:
        """Scores of the draws, then that of the gain, shape (B + 1,); many rules ask for them."""
        return _scores(torch.cat([self.null, self.null.new_tensor([self.gain])]), self.least_spread)


def _scores(values: Tensor, least_spread: float) -> Tensor:
    """Return values above their median, in standard deviations of their upper half."""
    middle, high = torch.quantile(values, values.new_tensor([0.5, 0.95]))
    return (values - middle) / ((high - middle) / NORMAL_95).clamp(min=least_spread)


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
        family = list(self.tests.values())
        if name in self.probes:
            family += self.probes.values()
        best = torch.stack([test.null_scores() for test in family]).amax(0)
        return share_of(best, (self.probes.get(name) or self.tests[name]).score)

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
        drawn = [one for one in self.tests.values() if one.null_closed is not None]
        if drawn:
            best = torch.stack([one.closed_scores(self.least)[:-1] for one in drawn]).amax(0)
            p_value = either(p_value, share_of(best, test.closed_scores()[-1]))
        return max(p_value, test.p_value)

    def _best_named(self) -> Tensor:
        """Return the highest score of every draw among effects that close enough, shape (B,)."""
        return torch.stack([test.null_scores(self.least) for test in self.tests.values()]).amax(0)

    def ordered(self) -> list[EffectTest]:
        """Return the tests of effects in descending order of what they close."""
        return sorted(self.tests.values(), key=lambda test: -test.total)

    def critical_score(self, level: float) -> float:
        """Return the score that an effect that could be named exceeds by chance at this level.

        It is at least that of an effect which is significant by itself.
        """
        best = self._best_named().clamp(min=NORMAL_95)
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
    sums, candidates = study.sums, study.candidates
    squares = HeldOutSquares(sums.ols, chosen, study.folds)
    others = [name for name in sums.layout.effects if name not in chosen]
    most = [name for name in others if not candidates.is_tested_by_tiles(name)]
    few = [name for name in others if candidates.is_tested_by_tiles(name)]
    null, by_chance = None, {}
    if flips:
        null = NullScores(sums, study.folds, len(study.signs), study.options.seed + seed_of_draws)
        if not chosen:
            by_chance = squares.closed_by_chance(most, null.even_of_folds())
    gains = student_gains(sums.gls, chosen, most, study.folds, null)
    closed = {name: squares.closed(name) for name in most}
    if few:
        closed_by_tiles, gains_by_tiles = _by_tiles(study, chosen, few, flips=flips)
        closed, gains = closed | closed_by_tiles, gains | gains_by_tiles
    if maps and candidates.maps:
        closed_by_maps, gains_by_maps = _of_maps(study, chosen, squares, flips=flips)
        closed, gains = closed | closed_by_maps, gains | gains_by_maps
    tests = {
        name: EffectTest(
            name=name,
            closed=closed[name],
            gain=float(gains[name][0]),
            null=gains[name][1:],
            null_closed=by_chance.get(name),
            size=_size(study, name),
            by_tiles=candidates.is_tested_by_tiles(name),
        )
        for name in [*others, *(name for name in closed if name in candidates.maps)]
    }
    least = (study.material_mm / 1000) ** 2 * float(sums.count.sum())
    return EffectComparison(
        chosen=tuple(chosen),
        squares=squares.squares,
        tests={name: test for name, test in tests.items() if name not in candidates.probes},
        probes={name: test for name, test in tests.items() if name in candidates.probes},
        least=-math.inf if chosen else least,
    )


def _by_tiles(
    study: Study, chosen: Sequence[str], names: Sequence[str], *, flips: bool
) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Return what each effect closes of every pose, and its gains; tiles are the units."""
    tiles = study.tiles
    assert tiles is not None
    sums = tile_sums(study.system, [*chosen, *names], tiles, study.fit)
    squares = HeldOutSquares(sums.ols, chosen, tiles.folds)
    closed = {name: tiles.per_pose(squares.closed(name), study.sums.num_units) for name in names}
    if flips:
        return closed, flipped_gains(sums.gls, chosen, names, tiles.folds, tiles.signs)
    return closed, dict.fromkeys(names, torch.full((1,), torch.nan, dtype=torch.float64))


def _of_maps(
    study: Study, chosen: Sequence[str], squares: HeldOutSquares, *, flips: bool
) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Return what each effect with one value a cell closes of every pose, and its gains.

    The residual is that of the generalised fit: the bend that an ordinary fit leaves in every image
    would pass for a map.
    """
    residual = study.system.residual_of(chosen, gls=True)
    left_out = left_out_residual(study, chosen, study.sums.gls) if flips else None
    closed, gains = {}, {}
    for name, effect in study.candidates.maps.items():
        gain = map_gain(study, effect, residual, left_out)
        closed[name] = squares.squares - _squares_without(study, chosen, gain.values)
        gains[name] = torch.cat([gain.gain.sum()[None], gain.null])
    return closed, gains


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
    system, observations = study.system, study.observations
    parts = system.of(chosen)
    theta = sums.left_out_solutions(chosen)[observations.unit][:, :, None]
    of_parts = theta.split([part.shape[1] for part in parts], dim=1)
    left = system.residual
    for part, own in zip(parts, of_parts, strict=True):
        left = left - by_frame(part, own, observations.frame)[:, 0]
    return left


def held_out_squares(study: Study, chosen: Sequence[str]) -> Tensor:
    """Return the sum of squared held-out residuals of each pose, shape (U,), m^2.

    Args:
        study: The recording.
        chosen: Effects of the model, all with columns.
    """
    return HeldOutSquares(study.sums.ols, chosen, study.folds).squares


def _size(study: Study, name: str) -> int:
    """Return the number of an effect's columns or cells."""
    if name in study.candidates.maps:
        effect = study.candidates.maps[name]
        return effect.num_cells(effect.shape)
    return len(range(*study.sums.layout.effects[name]))


def closed_square(study: Study, test: EffectTest) -> float:
    """Return the fall of the held-out mean square by an effect, m^2."""
    return test.total / float(study.sums.count.sum())


def least_p_value(study: Study, comparison: EffectComparison) -> float:
    """Return the smallest p-value of all effects and probes that close `material_mm`; 1 if none.

    Significant but tiny effects are not counted.
    """
    least = (study.material_mm / 1000) ** 2
    found = [1.0]
    for p_value, tests in (
        (comparison.naming_p_value, comparison.tests),
        (comparison.family_p_value, comparison.probes),
    ):
        found += [p_value(one.name) for one in tests.values() if closed_square(study, one) >= least]
    return min(found)
