"""Which effect is missing: held-out gain, its null distribution, and what cannot be told apart."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy import stats
from torch import Tensor

from tofcorr.diagnosis.sums.blocks import solve
from tofcorr.diagnosis.sums.crossval import flipped_gains, held_out_squares, left_out_solutions
from tofcorr.diagnosis.sums.map_gain import map_gain
from tofcorr.diagnosis.sums.study import Study

# The 95 % quantile of a normal distribution in standard deviations.
_Q95 = 1.6449


@dataclass(frozen=True, kw_only=True)
class EffectTest:
    """What adding one effect to a model brings.

    Attributes:
        name: Of the effect.
        closed: Fall of the even sum of squares of each held-out pose, shape (U,), m^2.
        gain: Fall of its chi-squared, over all poses.
        null: Total gain under sign flips, shape (B,).
        size: Number of its columns or cells.
    """

    name: str
    closed: Tensor
    gain: float
    null: Tensor
    size: int

    @property
    def total(self) -> float:
        """Fall of the sum of squares over all poses, m^2."""
        return float(self.closed.sum())

    @property
    def score(self) -> float:
        """Gain over the median of its own null, in units of the null's upper spread.

        The lower tail is left out of it: held-out gains have rare large losses, where an effect
        was fitted without the few poses that determine it. The observed value counts in.
        """
        return float(self._standardised()[-1])

    @property
    def p_value(self) -> float:
        """Share of flips that gain as much, were this effect the only one looked at."""
        return float((1 + (self.null >= self.gain).sum()) / (len(self.null) + 1))

    def null_scores(self) -> Tensor:
        """Return the standardised gains of the flips, shape (B,)."""
        return self._standardised()[:-1]

    def _standardised(self) -> Tensor:
        values = torch.cat([self.null, self.null.new_tensor([self.gain])])
        middle, high = torch.quantile(values, values.new_tensor([0.5, 0.95]))
        return (values - middle) / ((high - middle) / _Q95).clamp(min=1e-12)


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """All effects side by side, as additions to one model.

    Attributes:
        chosen: Effects of the model.
        squares: Of the model alone, held out, even weights, shape (U,), m^2.
        tests: By name.
        probes: The same for marks of effects beyond the catalogue.
    """

    chosen: tuple[str, ...]
    squares: Tensor
    tests: dict[str, EffectTest]
    probes: dict[str, EffectTest]

    def family_p_value(self, name: str) -> float:
        """Return the share of flips whose best effect scores as high as this one."""
        family = list(self.tests.values())
        if name in self.probes:
            family += self.probes.values()
        best = torch.stack([test.null_scores() for test in family]).amax(0)
        test = self.probes.get(name) or self.tests[name]
        return float((1 + (best >= test.score).sum()) / (len(best) + 1))

    def ordered(self) -> list[EffectTest]:
        """Return the tests, the one that closes most first."""
        return sorted(self.tests.values(), key=lambda test: -test.total)


def compare(
    study: Study, chosen: Sequence[str], *, flips: bool = True, maps: bool = True
) -> Comparison:
    """Test every effect that is not in the model as an addition to it.

    Args:
        study: The recording.
        chosen: Effects of the model, all with columns.
        flips: Whether to draw the null distributions; without them tests have no p-value.
        maps: Whether to look at effects with one value a cell of the image.
    """
    blocks, folds = study.blocks, study.folds
    squares = held_out_squares(blocks, chosen, folds)
    tests: dict[str, EffectTest] = {}
    probes: dict[str, EffectTest] = {}
    for name, (low, high) in blocks.layout.effects.items():
        if name in chosen:
            continue
        names = [*chosen, name]
        if study.shown_by_few(name):
            closed, gains = _in_parts(study, chosen, names, flips=flips)
        else:
            signs = study.signs if flips else study.signs[:0]
            gains = flipped_gains(blocks.likely, chosen, names, folds, signs)
            closed = squares - held_out_squares(blocks, names, folds)
        test = EffectTest(
            name=name, closed=closed, gain=float(gains[0]), null=gains[1:], size=high - low
        )
        (tests if name in study.effects else probes)[name] = test
    if study.maps and maps:
        tests |= _map_tests(study, chosen, flips=flips)
    return Comparison(chosen=tuple(chosen), squares=squares, tests=tests, probes=probes)


def _in_parts(
    study: Study, chosen: Sequence[str], names: Sequence[str], *, flips: bool
) -> tuple[Tensor, Tensor]:
    """Return what one more effect closes, (U,), and its gains, (1 + B,), by parts of images."""
    parts = study.parts
    assert parts is not None
    blocks = study.in_parts(names)
    signs = parts.signs if flips else parts.signs[:0]
    gains = flipped_gains(blocks.likely, chosen, names, parts.folds, signs)
    before = held_out_squares(blocks, chosen, parts.folds)
    closed = before - held_out_squares(blocks, names, parts.folds)
    return parts.per_pose(closed, study.blocks.num_units), gains


def _map_tests(study: Study, chosen: Sequence[str], *, flips: bool) -> dict[str, EffectTest]:
    residual = study.residual_of(chosen)
    left_out = left_out_residual(study, chosen) if flips else None
    tests = {}
    for name, effect in study.maps.items():
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
    """Return residuals whose size is that of the errors, shape (M,), metres."""
    members = study.blocks.layout.of(chosen)
    theta = left_out_solutions(study.blocks.even, chosen)
    return study.residual - (study.columns[:, members] * theta[study.unit_of_pixel]).sum(1)


def cause_set(comparison: Comparison, winner: str, level: float, share: float) -> list[str]:
    """Return the effects that these data cannot tell from the winner, itself first.

    An effect belongs to the set if it closes not significantly less than the winner (paired over
    poses) while at least half as much, or if it reaches `share` of it.
    """
    best = comparison.probes.get(winner) or comparison.tests[winner]
    members = []
    for test in comparison.ordered():
        if test.name == winner or test.total <= 0.5 * best.total:
            continue
        less = (best.closed - test.closed).numpy()
        spread = float(np.std(less, ddof=1)) / np.sqrt(len(less))
        t = float(np.mean(less)) / max(spread, 1e-30)
        alike = t <= float(stats.t.ppf(1 - level, len(less) - 1))
        if alike or test.total >= share * best.total:
            members.append(test.name)
    return [winner, *members]


def absorbed_share(study: Study, name: str, others: Sequence[str] = ()) -> float:
    """Return the share of an effect's signal that base model and other effects take up.

    The signal is drawn from the effect's prior; 1 means that nothing of it can be seen.
    """
    sums = study.blocks.even
    low, high = sums.layout.effects[name]
    gram = sums.gram.sum(0)
    members = sums.layout.of(others)
    own = gram[low:high, low:high]
    cross = gram[members, low:high]
    inner = gram[members][:, members] + torch.diag(sums.layout.prior[members])
    left = own - cross.T @ torch.linalg.solve(inner, cross)
    total = float(own.trace())
    return float(np.clip(1.0 - float(left.trace()) / total, 0.0, 1.0)) if total > 0 else 1.0


def fitted_coefficients(study: Study, chosen: Sequence[str]) -> dict[str, Tensor]:
    """Return the coefficients of chosen effects in their own units, by name."""
    named = [name for name in chosen if name in study.effects]
    theta = solve(study.blocks.even, named)
    found, start = {}, study.blocks.layout.base
    for name in named:
        effect = study.effects[name]
        size = len(effect.coefficients)
        found[name] = theta[start : start + size] * effect.prior_sd()
        start += size
    return found
