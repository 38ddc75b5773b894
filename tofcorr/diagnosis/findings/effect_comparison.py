"""The test of one effect as an addition to a model: what it gains, and what chance would.

Gains of further effects beside a model, each tested by the units that suit it.

Tests of all effects side by side, as additions to one model.

What effects gain in likelihood, pose by pose.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor

from tofcorr.diagnosis.sums.gains import FlippedGains, HeldOutSquares, student_gains
from tofcorr.diagnosis.sums.linear_system import Sums, left_out_solutions
from tofcorr.diagnosis.sums.map_gain import map_gain
from tofcorr.diagnosis.sums.study import Study, likely_residual_of, tile_blocks
from tofcorr.simulation.effects.numerics import by_frame

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


class Gain(NamedTuple):
    """What one effect gains beside a model.

    Attributes:
        closed: What it closes of every pose, shape (U,), m^2.
        gains: Its gain, then those by chance, shape (1 + B,).
        null_closed: What it closes by chance, over all poses, shape (B,), m^2; None: not drawn.
    """

    closed: Tensor
    gains: Tensor
    null_closed: Tensor | None = None


Gains = dict[str, Gain]


def effect_gains(
    study: Study, chosen: Sequence[str], squares: HeldOutSquares, *, flips: bool, maps: bool
) -> Gains:
    """Return what each effect that is not in the model closes, and its gains.

    Args:
        study: The recording.
        chosen: Effects of the model, all with columns.
        squares: Of the model.
        flips: Whether to draw the null distributions.
        maps: Whether to test effects with one value a cell of the image.
    """
    maps = maps and bool(study.candidates.maps)
    if flips:
        return _with_columns(study, chosen, squares, flips=True, maps=maps)
    # Rules ask for the same sizes several times.
    found = study.remembered(
        f"what each closes beside {', '.join(sorted(chosen))}",
        lambda: _with_columns(study, chosen, squares, flips=False, maps=False),
    )
    return found | _of_maps(study, chosen, squares, flips=False) if maps else found


def _with_columns(
    study: Study, chosen: Sequence[str], squares: HeldOutSquares, *, flips: bool, maps: bool
) -> Gains:
    """Return the gains of effects with columns, and of maps if wanted."""
    layout = study.system.blocks.layout
    others = [name for name in layout.effects if name not in chosen]
    few = [name for name in others if study.candidates.is_tested_by_tiles(name)]
    most = [name for name in others if name not in few]
    gains = _gains_by_poses(study, chosen, most, flips=flips)
    closed = _closed_by_poses(study, chosen, squares, most, flips=flips)
    found = {name: Gain(closed[name][0], gains[name], closed[name][1]) for name in most}
    if few:
        found |= _by_tiles(study, chosen, few, flips=flips)
    return found | _of_maps(study, chosen, squares, flips=flips) if maps else found


def _gains_by_poses(
    study: Study, chosen: Sequence[str], names: Sequence[str], *, flips: bool
) -> dict[str, Tensor]:
    """Return the gain of each further effect, then those by chance; poses are the units.

    Args:
        study: The recording.
        chosen: Effects of the model.
        names: The further effects.
        flips: Whether to draw the null distributions.
    """
    system, resampling = study.system, study.resampling
    null = resampling.null_scores(system) if flips else None
    return student_gains(system.blocks.likely, chosen, names, resampling.folds, null)


def _closed_by_poses(
    study: Study,
    chosen: Sequence[str],
    squares: HeldOutSquares,
    names: Sequence[str],
    *,
    flips: bool,
) -> dict[str, tuple[Tensor, Tensor | None]]:
    """Return what each further effect closes of every pose, and by chance, as in `Gain`.

    Args:
        study: The recording.
        chosen: Effects of the model.
        squares: Of the model.
        names: The further effects.
        flips: Whether to draw the null distributions; only those of additions to the base model
            say what is closed by chance.
    """
    system = study.system
    by_chance: dict[str, Tensor] = {}
    if flips and not chosen:
        null = study.resampling.null_scores(system)
        drawn = null.even_of_folds(system.moments, system.blocks.even_scale)
        by_chance = squares.closed_by_chance(names, drawn)
    return {name: (squares.closed(name), by_chance.get(name)) for name in names}


def _by_tiles(study: Study, chosen: Sequence[str], names: Sequence[str], *, flips: bool) -> Gains:
    """Return what each further effect closes, and its gains, as in `Gains`; tiles are the units.

    Args:
        study: The recording.
        chosen: Effects of the model.
        names: The further effects.
        flips: Whether to draw the null distributions.
    """
    tiles = study.resampling.tiles
    assert tiles is not None
    blocks = tile_blocks(study, [*chosen, *names])
    squares = HeldOutSquares(blocks, chosen, tiles.folds)
    likely = blocks.likely
    gains = FlippedGains(likely, chosen, tiles.folds, tiles.signs).of if flips else _unknown_gain
    units = study.system.blocks.num_units
    return {name: Gain(tiles.per_pose(squares.closed(name), units), gains(name)) for name in names}


def _unknown_gain(_: str) -> Tensor:
    return torch.full((1,), torch.nan, dtype=torch.float64)


def _of_maps(study: Study, chosen: Sequence[str], squares: HeldOutSquares, *, flips: bool) -> Gains:
    """Return what each effect with one value a cell closes, and its gains, as in `Gains`.

    The residual is that of the likely fit: the bend that an even fit leaves in every image would
    pass for a map.
    """
    residual = likely_residual_of(study, chosen)
    left_out = left_out_residual(study, chosen, study.system.blocks.likely) if flips else None
    found: Gains = {}
    for name, effect in study.candidates.maps.items():
        gain = map_gain(study, effect, residual, left_out)
        closed = squares.squares - _squares_without(study, chosen, gain.values)
        found[name] = Gain(closed, torch.cat([gain.gain.sum()[None], gain.null]))
    return found


def _squares_without(study: Study, chosen: Sequence[str], values: Tensor) -> Tensor:
    """Return the even sum of squares of each held-out pose once a map is subtracted, (U,), m^2.

    The model is fitted again, as it is beside any other effect: without the map its errors bent it.
    """
    system, blocks, share = study.system, study.system.blocks, study.fit.share
    left = system.residual - values
    even = blocks.even_scale * share * left
    products = study.observations.products
    scores = [products(own, even[:, None])[..., 0] for own in system.columns.of(chosen)]
    sums = Sums(
        gram=blocks.even.of(chosen)[0],
        score=torch.cat(scores, dim=1),
        layout=blocks.layout.only(chosen),
    )
    square = torch.zeros_like(blocks.square).index_add(0, study.unit_of_pixel, share * left**2)
    changed = replace(blocks, even=sums, square=square)
    return HeldOutSquares(changed, chosen, study.resampling.folds).squares


def left_out_residual(study: Study, chosen: Sequence[str], sums: Sums) -> Tensor:
    """Return residuals with the variance of the errors, shape (M,), metres.

    Args:
        study: The recording.
        chosen: Effects of the model.
        sums: Even or likely sums of every pose, by which the model is fitted.
    """
    system, observations = study.system, study.observations
    parts = system.columns.of(chosen)
    theta = left_out_solutions(sums, chosen)[observations.unit][:, :, None]
    of_parts = theta.split([part.shape[1] for part in parts], dim=1)
    left = system.residual
    for part, own in zip(parts, of_parts, strict=True):
        left = left - by_frame(part, own, observations.frame)[:, 0]
    return left


@dataclass(frozen=True, kw_only=True)
class EffectComparison:
    """All effects side by side, as additions to one model.

    Attributes:
        chosen: Effects of the model.
        squares: Even sum of squares of each held-out pose, of the model alone, shape (U,), m^2.
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
    study: Study, chosen: Sequence[str], *, flips: bool = True, maps: bool = True
) -> EffectComparison:
    """Test every effect that is not in the model as an addition to it.

    Args:
        study: The recording.
        chosen: Effects of the model, all with columns.
        flips: Whether to draw the null distributions; without them tests have no p-value.
        maps: Whether to test effects with one value a cell of the image.
    """
    blocks, candidates = study.system.blocks, study.candidates
    others = [name for name in blocks.layout.effects if name not in chosen]
    squares = HeldOutSquares(blocks, chosen, study.resampling.folds)
    found = effect_gains(study, chosen, squares, flips=flips, maps=maps)
    tests: dict[str, EffectTest] = {}
    probes: dict[str, EffectTest] = {}
    for name in [*others, *(name for name in found if name in candidates.maps)]:
        own = found[name]
        test = EffectTest(
            name=name,
            closed=own.closed,
            gain=float(own.gains[0]),
            null=own.gains[1:],
            null_closed=own.null_closed,
            size=_size(study, name),
            by_tiles=candidates.is_tested_by_tiles(name),
        )
        (probes if name in candidates.probes else tests)[name] = test
    least = (study.material_mm * 1e-3) ** 2 * float(blocks.count.sum())
    return EffectComparison(
        chosen=tuple(chosen),
        squares=squares.squares,
        tests=tests,
        probes=probes,
        least=-math.inf if chosen else least,
    )


def held_out_squares(study: Study, chosen: Sequence[str]) -> Tensor:
    """Return the sum of squared held-out residuals of each pose, shape (U,), m^2.

    Args:
        study: The recording.
        chosen: Effects of the model, all with columns.
    """
    return HeldOutSquares(study.system.blocks, chosen, study.resampling.folds).squares


def _size(study: Study, name: str) -> int:
    """Return the number of an effect's columns or cells."""
    if name in study.candidates.maps:
        effect = study.candidates.maps[name]
        return effect.num_cells(effect.shape)
    return study.system.blocks.layout.size(name)


def closed_square(study: Study, test: EffectTest) -> float:
    """Return the fall of the held-out mean square by an effect, m^2."""
    return test.total / float(study.system.blocks.count.sum())


def least_p_value(study: Study, comparison: EffectComparison) -> float:
    """Return the smallest p-value of all effects and probes that close `material_mm`; 1 if none.

    Significant but tiny effects are not counted.
    """
    least = (study.material_mm * 1e-3) ** 2
    found = [1.0]
    for p_value, tests in (
        (comparison.naming_p_value, comparison.tests),
        (comparison.family_p_value, comparison.probes),
    ):
        found += [p_value(one.name) for one in tests.values() if closed_square(study, one) >= least]
    return min(found)


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
