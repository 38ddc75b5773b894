"""Tests of all effects side by side, as additions to one model."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from tofcorr.diagnosis.findings.effect_gains import effect_gains
from tofcorr.diagnosis.findings.effect_test import NORMAL_95, EffectTest, either, share_of
from tofcorr.diagnosis.sums.additions import HeldOutSquares
from tofcorr.diagnosis.sums.study import Study


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
