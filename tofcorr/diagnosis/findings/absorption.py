"""How much of an effect the calibration, estimated planes or another effect absorb.

What planes absorb is said by name, and not judged where hardly anything remains.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from tofcorr.diagnosis.sums.study import Study, build_study
from tofcorr.simulation.effects.inputs import MEASURED_PLANES

# If calibration leaves less than this share of an effect, its overlap with other effects is not
# computed: it would be a quotient of two rounding errors. Chosen.
_NOTHING_LEFT = 0.005


def absorbed_share(study: Study, name: str, others: Sequence[str] = ()) -> float:
    """Return the share of an effect's signal that base model and other effects absorb.

    The share is averaged over the effect's prior. 1 means that nothing of it can be observed.
    """
    layout = study.sums.layout
    total, left = signal(study, name), _left(study, name, layout.of(others))
    return float(np.clip(1.0 - left / total, 0.0, 1.0)) if total > 0 else 1.0


def signal(study: Study, name: str) -> float:
    """Return the sum of an effect's squares, averaged over its prior."""
    low, high = study.sums.layout.effects[name]
    return float(study.sums.ols.total.diagonal()[low:high].sum())


def _left(study: Study, name: str, members: Tensor) -> float:
    """Return what regression on columns (K,) leaves of an effect, averaged over its prior."""
    ols, own = study.sums.ols, torch.arange(*study.sums.layout.effects[name])
    return float(left_over(ols.total, members, own, ols.layout.prior_of(members)).trace())


def left_over(gram: Tensor, members: Tensor, own: Tensor, prior: Tensor) -> Tensor:
    """Return the Gram matrix of an effect after regression on other columns, a Schur complement.

    Args:
        gram: Of all columns, one or many, shape (..., P, P).
        members: Numbers of the other columns, shape (K,).
        own: Numbers of the effect's columns, shape (E,).
        prior: Prior precision of the other coefficients, shape (K, K).
    """
    inner, cross = gram[..., members[:, None], members] + prior, gram[..., members[:, None], own]
    return gram[..., own[:, None], own] - cross.mT @ torch.linalg.solve(inner, cross)


def absorption_table(study: Study) -> np.ndarray:
    """Return what calibration and every other effect absorb of every effect with columns.

    Returns:
        The share of each effect (row) that base model and hand-eye transform absorb, then of what
        remains the share that each other effect (column) absorbs; NaN of itself and where nothing
        remains. Shape (E, 1 + E).
    """
    names = tuple(study.candidates.effects)
    table = np.full((len(names), 1 + len(names)), np.nan)
    for row, name in enumerate(names):
        own = table[row, 0] = absorbed_share(study, name)
        for column, other in enumerate(names, start=1):
            if other != name and 1 - own > _NOTHING_LEFT:
                table[row, column] = (absorbed_share(study, name, [other]) - own) / (1 - own)
    return table


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
    model, everything = study.fit.model, torch.arange(study.sums.layout.base)
    planes = (everything >= model.num_hand_eye) & (everything < model.num_geometry)
    measured = _left(study, name, everything[~planes])
    if measured <= _NOTHING_LEFT * signal(study, name):
        return 0.0
    return 1.0 - _left(study, name, everything) / measured
