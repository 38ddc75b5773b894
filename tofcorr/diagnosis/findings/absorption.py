"""How much of an effect the calibration, or another effect, absorbs."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from tofcorr.diagnosis.sums.blocks import solve
from tofcorr.diagnosis.sums.study import Study

# If calibration leaves less than this share of an effect, its overlap with other effects is not
# computed: it would be a quotient of two rounding errors. Chosen.
_NOTHING_LEFT = 0.005


@dataclass(frozen=True, kw_only=True)
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
    sums = study.system.blocks.even
    low, high = sums.layout.effects[name]
    gram = sums.total
    members = sums.layout.of(others)
    own = gram[low:high, low:high]
    left = left_over(gram, members, low, high, sums.layout.prior_of(members))
    total = float(own.trace())
    return float(np.clip(1.0 - float(left.trace()) / total, 0.0, 1.0)) if total > 0 else 1.0


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
    return AbsorptionTable(names=names, by_calibration=by_calibration, by_effect=by_effect)


def fitted_coefficients(study: Study, chosen: Sequence[str]) -> dict[str, Tensor]:
    """Return the coefficients of chosen effects in their own units, by name."""
    known = [name for name in chosen if name in study.candidates.effects]
    theta = solve(study.system.blocks.even, known)
    found, start = {}, study.system.blocks.layout.base
    for name in known:
        effect = study.candidates.effects[name]
        size = len(effect.coefficients)
        found[name] = theta[start : start + size] * effect.prior_sd()
        start += size
    return found
