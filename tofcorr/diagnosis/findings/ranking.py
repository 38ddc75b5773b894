"""Every effect as the first addition to the base model, the best first."""

from dataclasses import dataclass

from tofcorr.diagnosis.findings.absorption import absorbed_share
from tofcorr.diagnosis.findings.effect_comparison import closed_square
from tofcorr.diagnosis.findings.naming import NamedEffects
from tofcorr.diagnosis.sums.study import Study


@dataclass(frozen=True, kw_only=True)
class RankedEffect:
    """One effect as an addition to the base model alone.

    Attributes:
        name: Of the effect.
        closes: By how much it lowers the gap, metres; negative where it makes predictions worse.
        closed_fraction: Share of the squared gap that it closes, 0 to 1.
        p_value: Adjusted for the number of effects.
        aliases: Other effects of its cause set.
        gain: Fall of the held-out chi-squared.
        score: Gain above the median of its null, in standard deviations.
        absorbed: Share of the effect that calibration absorbs; None for maps.
    """

    name: str
    closes: float
    closed_fraction: float
    p_value: float
    aliases: tuple[str, ...]
    gain: float
    score: float
    absorbed: float | None


def rank_effects(study: Study, named: NamedEffects) -> tuple[RankedEffect, ...]:
    """Return all tested effects in descending order of what they close."""
    first = named.first
    total = float(first.squares.sum() / study.system.blocks.count.sum())
    before = max(total - study.fit.floor**2, 0.0)
    ranked = []
    for test in first.ordered():
        closed = closed_square(study, test)
        after = max(before - closed, 0.0) ** 0.5
        has_columns = test.name in study.candidates.effects
        ranked.append(
            RankedEffect(
                name=test.name,
                closes=before**0.5 - after,
                closed_fraction=min(max(closed / before, 0.0), 1.0) if before > 0 else 0.0,
                p_value=first.naming_p_value(test.name),
                aliases=_aliases(named, test.name),
                gain=test.gain,
                score=test.score,
                absorbed=absorbed_share(study, test.name) if has_columns else None,
            )
        )
    return tuple(ranked)


def _aliases(named: NamedEffects, name: str) -> tuple[str, ...]:
    for members in named.cause_sets:
        if name in members:
            return tuple(other for other in members if other != name)
    return ()
