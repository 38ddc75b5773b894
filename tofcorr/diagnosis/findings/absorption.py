"""How much of an effect the calibration, estimated planes or another effect absorb.

What planes absorb is said by name, and not judged where hardly anything remains. And every effect
as the first addition to the base model, the best first.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from tofcorr.diagnosis.findings.effect_comparison import closed_square
from tofcorr.diagnosis.findings.naming import NamedEffects
from tofcorr.diagnosis.sums.study import Study, build_study
from tofcorr.simulation.effects.inputs import MEASURED_PLANES

# If calibration leaves less than this share of an effect, its overlap with other effects is not
# computed: it would be a quotient of two rounding errors. Chosen.
_NOTHING_LEFT = 0.005


@dataclass(frozen=True)
class AbsorptionTable:
    """Shares of each effect that others absorb.

    Attributes:
        names: The effects, E of them.
        by_calibration: Share of each effect that base model and hand-eye transform absorb, (E,).
        by_effect: Of what remains, the share of each effect (row) that each other effect (column)
            absorbs, shape (E, E); NaN on the diagonal and where nothing remains.
    """

    names: tuple[str, ...]
    by_calibration: np.ndarray
    by_effect: np.ndarray


def absorbed_share(study: Study, name: str, others: Sequence[str] = ()) -> float:
    """Return the share of an effect's signal that base model and other effects absorb.

    The share is averaged over the effect's prior. 1 means that nothing of it can be observed.
    """
    ols = study.sums.ols
    low, high = ols.layout.effects[name]
    total = float(ols.total[low:high, low:high].trace())
    left = _left(study, name, ols.layout.of(others))
    return float(np.clip(1.0 - left / total, 0.0, 1.0)) if total > 0 else 1.0


def _left(study: Study, name: str, members: Tensor) -> float:
    """Return what regression on columns (K,) leaves of an effect, averaged over its prior."""
    ols = study.sums.ols
    ends, prior = ols.layout.effects[name], ols.layout.prior_of(members)
    return float(left_over(ols.total, members, *ends, prior).trace())


def left_over(gram: Tensor, members: Tensor, low: int, high: int, prior: Tensor) -> Tensor:
    """Return the Gram matrix of an effect after regression on other columns, a Schur complement.

    Args:
        gram: Of all columns, shape (P, P).
        members: Numbers of the other columns, shape (K,).
        low: First column of the effect.
        high: One past its last column.
        prior: Prior precision of the other coefficients, shape (K, K).
    """
    own = torch.cat([members, torch.arange(low, high)])
    return remainder(gram[own[:, None], own], len(members), prior)


def remainder(gram: Tensor, count: int, prior: Tensor) -> Tensor:
    """Return the Gram matrix of the last columns after regression on the first ones.

    Args:
        gram: Of the columns, one or many, shape (..., P, P).
        count: Number of the first ones, K.
        prior: Prior precision of their coefficients, shape (K, K).
    """
    inner, cross = gram[..., :count, :count] + prior, gram[..., :count, count:]
    return gram[..., count:, count:] - cross.mT @ torch.linalg.solve(inner, cross)


def absorption_table(study: Study) -> AbsorptionTable:
    """Return what calibration and every other effect absorb of every effect with columns."""
    names = tuple(study.candidates.effects)
    by_calibration = np.array([absorbed_share(study, name) for name in names])
    by_effect = np.full((len(names), len(names)), np.nan)
    for row, name in enumerate(names):
        rest = 1 - by_calibration[row]
        for column, other in enumerate(names):
            if other != name and rest > _NOTHING_LEFT:
                taken = absorbed_share(study, name, [other]) - by_calibration[row]
                by_effect[row, column] = taken / rest
    return AbsorptionTable(names, by_calibration, by_effect)


def fitted_coefficients(study: Study, chosen: Sequence[str]) -> dict[str, Tensor]:
    """Return the coefficients of chosen effects in their own units, by name."""
    known = [name for name in chosen if name in study.candidates.effects]
    theta, effects = study.sums.ols.solve(known), study.candidates.effects
    parts = theta[study.sums.layout.base :].split([len(effects[n].coefficients) for n in known])
    return {n: own * effects[n].prior_sd() for n, own in zip(known, parts, strict=True)}


def without_absorbed(
    study: Study, *, not_judged: float = 0.95, worth_saying: float = 0.5
) -> tuple[Study, list[str]]:
    """Return the study without the effects that estimated planes absorb, and a warning.

    The effects left out are among `missing`: they need measured planes. A study of measured planes
    stays as it is.

    Args:
        study: The recording.
        not_judged: An effect is not judged if estimated planes absorb more than this share of what
            measured planes would leave of it: a twentieth of an effect looks like others. Chosen.
        worth_saying: Above this share a warning names the effect. Chosen: its smallest detectable
            size has grown by more than a factor of 1.4.
    """
    if not study.observations.num_walls:
        return study, []
    shares = {name: absorbed_by_planes(study, name) for name in study.candidates.effects}
    hidden = [name for name, share in shares.items() if share > not_judged]
    if hidden:
        # Drawn again from the same seed.
        options = study.options
        fewer = options.model_copy(update={"leave_out": (*options.leave_out, *hidden)})
        generator = torch.Generator().manual_seed(options.seed)
        again = build_study(fewer, study.observations, study.fit, study.inputs, generator)
        wants = {name: [MEASURED_PLANES.words] for name in hidden}
        candidates = replace(again.candidates, missing={**again.candidates.missing, **wants})
        study = replace(again, options=options, candidates=candidates)
    partly = [
        f"{name} ({100 * share:.0f} %)"
        for name, share in shares.items()
        if worth_saying < share <= not_judged
    ]
    return study, [_warning(study, partly)]


def _warning(study: Study, partly: Sequence[str]) -> str:
    count, missing = study.observations.num_walls, study.candidates.missing
    unjudged = [name for name, wants in missing.items() if MEASURED_PLANES.words in wants]
    planes = "plane of 1 wall is" if count == 1 else f"planes of {count} walls are"
    sentence = f"The {planes} estimated together with the base model (recording.yaml: planes)."
    if unjudged:
        sentence += f" Not judged, because measured planes are needed: {', '.join(unjudged)}."
    if partly:
        sentence += f" Estimated planes absorb a large share of {', '.join(partly)}."
    return sentence


def absorbed_by_planes(study: Study, name: str) -> float:
    """Return the share that estimated planes absorb of what measured planes would leave."""
    ols, model = study.sums.ols, study.fit.model
    low, high = ols.layout.effects[name]
    everything = torch.arange(ols.layout.base)
    planes = (everything >= model.num_hand_eye) & (everything < model.num_geometry)
    measured = _left(study, name, everything[~planes])
    whole = float(ols.total[low:high, low:high].trace())
    if measured <= _NOTHING_LEFT * whole:
        return 0.0
    return 1.0 - _left(study, name, everything) / measured


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
    total = float(first.squares.sum() / study.sums.count.sum())
    before = max(total - study.fit.floor**2, 0.0)
    ranked = []
    for test in first.ordered():
        closed = closed_square(study, test)
        sets = [members for members in named.cause_sets if test.name in members]
        has_columns = test.name in study.candidates.effects
        ranked.append(
            RankedEffect(
                name=test.name,
                closes=before**0.5 - max(before - closed, 0.0) ** 0.5,
                closed_fraction=min(max(closed / before, 0.0), 1.0) if before > 0 else 0.0,
                p_value=first.naming_p_value(test.name),
                aliases=tuple(n for n in sets[0] if n != test.name) if sets else (),
                gain=test.gain,
                score=test.score,
                absorbed=absorbed_share(study, test.name) if has_columns else None,
            )
        )
    return tuple(ranked)
