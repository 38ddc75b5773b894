"""Tests of each effect as an addition to a model: held-out gain and null distribution."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from tofcorr.diagnosis.sums.additions import FlippedGains, HeldOutSquares
from tofcorr.diagnosis.sums.crossval import left_out_solutions
from tofcorr.diagnosis.sums.left_out import tile_blocks
from tofcorr.diagnosis.sums.map_gain import map_gain
from tofcorr.diagnosis.sums.student_gains import student_gains
from tofcorr.diagnosis.sums.study import Study, residual_of
from tofcorr.simulation.effects.derivative import by_frame

NORMAL_95 = 1.6449
"""The 95 % quantile of a normal distribution, standard deviations. A mathematical constant."""
# Least spread of the gains under flips, in units of chi-squared, that a score is measured in.
# Chosen: far below one, what noise alone gives, and far above rounding, which is all that an effect
# of a constant condition shows.
_LEAST_SPREAD = 1e-6


@dataclass(frozen=True, kw_only=True)
class EffectTest:
    """The gain by adding one effect to a model.

    Attributes:
        name: Of the effect.
        closed: Fall of the even sum of squares of each held-out pose, shape (U,), m^2.
        gain: Fall of the held-out chi-squared, over all poses.
        null: Gain by chance, shape (B,); empty where no null distribution was asked for.
        size: Number of the effect's columns or cells.
        by_tiles: Whether tiles of images were the units of `gain` and `null`.
    """

    name: str
    closed: Tensor
    gain: float
    null: Tensor
    size: int
    by_tiles: bool = False

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
        return float(self._standardised()[-1])

    @property
    def p_value(self) -> float:
        """Share of flips with at least this gain, if this effect were the only one tested."""
        return float((1 + (self.null >= self.gain).sum()) / (len(self.null) + 1))

    def null_scores(self) -> Tensor:
        """Return the scores of the flips, shape (B,)."""
        return self._standardised()[:-1]

    def _standardised(self) -> Tensor:
        values = torch.cat([self.null, self.null.new_tensor([self.gain])])
        middle, high = torch.quantile(values, values.new_tensor([0.5, 0.95]))
        return (values - middle) / ((high - middle) / NORMAL_95).clamp(min=_LEAST_SPREAD)


@dataclass(frozen=True, kw_only=True)
class EffectComparison:
    """All effects side by side, as additions to one model.

    Attributes:
        chosen: Effects of the model.
        squares: Even sum of squares of each held-out pose, of the model alone, shape (U,), m^2.
        tests: Of the effects, by name.
        probes: Of the probes, by name.
    """

    chosen: tuple[str, ...]
    squares: Tensor
    tests: dict[str, EffectTest]
    probes: dict[str, EffectTest]

    def family_p_value(self, name: str) -> float:
        """Return the share of flips whose best effect scores at least as high as this one.

        A probe is compared with the best of all effects and probes.
        """
        family = list(self.tests.values())
        if name in self.probes:
            family += self.probes.values()
        best = torch.stack([test.null_scores() for test in family]).amax(0)
        test = self.probes.get(name) or self.tests[name]
        return float((1 + (best >= test.score).sum()) / (len(best) + 1))

    def ordered(self) -> list[EffectTest]:
        """Return the tests of effects in descending order of what they close."""
        return sorted(self.tests.values(), key=lambda test: -test.total)

    def critical_score(self, level: float) -> float:
        """Return the score that the best of all effects exceeds by chance with this probability."""
        best = torch.stack([test.null_scores() for test in self.tests.values()]).amax(0)
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
    system, resampling = study.system, study.resampling
    others = [name for name in system.blocks.layout.effects if name not in chosen]
    few = [name for name in others if study.candidates.is_tested_by_tiles(name)]
    squares = HeldOutSquares(system.blocks, chosen, resampling.folds)
    by_poses = [name for name in others if name not in few]
    null = resampling.null_scores(system) if flips else None
    gains = student_gains(system.blocks.likely, chosen, by_poses, resampling.folds, null)
    by_tiles = _by_tiles(study, chosen, few, flips=flips) if few else {}
    tests: dict[str, EffectTest] = {}
    probes: dict[str, EffectTest] = {}
    for name in others:
        closed, own = by_tiles.get(name) or (squares.closed(name), gains[name])
        low, high = system.blocks.layout.effects[name]
        test = EffectTest(
            name=name,
            closed=closed,
            gain=float(own[0]),
            null=own[1:],
            size=high - low,
            by_tiles=name in by_tiles,
        )
        (tests if name in study.candidates.effects else probes)[name] = test
    if study.candidates.maps and maps:
        tests |= _map_tests(study, chosen, flips=flips)
    return EffectComparison(
        chosen=tuple(chosen), squares=squares.squares, tests=tests, probes=probes
    )


def _by_tiles(
    study: Study, chosen: Sequence[str], names: Sequence[str], *, flips: bool
) -> dict[str, tuple[Tensor, Tensor]]:
    """Return what each further effect closes, (U,), and its gains, (1 + B,); tiles are the units.

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
    return {name: (tiles.per_pose(squares.closed(name), units), gains(name)) for name in names}


def _unknown_gain(_: str) -> Tensor:
    return torch.full((1,), torch.nan, dtype=torch.float64)


def _map_tests(study: Study, chosen: Sequence[str], *, flips: bool) -> dict[str, EffectTest]:
    residual = residual_of(study, chosen)
    left_out = left_out_residual(study, chosen) if flips else None
    tests = {}
    for name, effect in study.candidates.maps.items():
        found = map_gain(study, effect, residual, left_out)
        tests[name] = EffectTest(
            name=name,
            closed=found.closed,
            gain=float(found.gain.sum()),
            null=found.null,
            size=effect.num_cells(effect.shape),
        )
    return tests


def left_out_residual(study: Study, chosen: Sequence[str]) -> Tensor:
    """Return residuals with the variance of the errors, shape (M,), metres."""
    system, observations = study.system, study.observations
    parts = system.columns.of(chosen)
    theta = left_out_solutions(system.blocks.even, chosen)[observations.unit][:, :, None]
    of_parts = theta.split([part.shape[1] for part in parts], dim=1)
    left = system.residual
    for part, own in zip(parts, of_parts, strict=True):
        left = left - by_frame(part, own, observations.frame)[:, 0]
    return left


def closed_square(study: Study, test: EffectTest) -> float:
    """Return the fall of the held-out mean square by an effect, m^2."""
    return test.total / float(study.system.blocks.count.sum())


def least_p_value(study: Study, comparison: EffectComparison) -> float:
    """Return the smallest p-value of all effects and probes that close `material_mm`; 1 if none.

    Significant but tiny effects are not counted.
    """
    least = (study.material_mm * 1e-3) ** 2
    candidates = (comparison.tests | comparison.probes).values()
    counting = [test.name for test in candidates if closed_square(study, test) >= least]
    return min((comparison.family_p_value(name) for name in counting), default=1.0)
