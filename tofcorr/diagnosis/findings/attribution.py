r"""Shares out the square of the gap as given over its causes.

The simulator as given leaves the residual r. Hand-eye transform, terms of the base model and named
effects are fitted to it together; each cause k then contributes a part g_k, and r = sum g_k + e. If
the simulator takes over the parameters of a set S of causes and keeps its own for all others, the
mean square falls by

.. math:: v(S) = |r|^2 - |r - \textstyle\sum_{k \in S} g_k|^2 .

The share of a cause is its Shapley value: its increment of v, averaged over all orders in which the
causes can be added. Because v is quadratic, that average has a closed form,

.. math:: \phi_k = \langle g_k,\; r + e \rangle ,

and every product is a sum of Gram matrices over the poses. The parts are fitted together, not
cause by cause: alone, a hand-eye transform would take up a constant distance error as well. Even
together the data do not tell all causes apart: whose a constant is (it counts as distance, see
`parts`), whether a parameter of the simulator needs a change (see `unchanged`), what of an effect
its model misses (see `hidden`), and how effects that vary alike share what they add (see
`shrinkage`). The intervals cover the last three as well.

Without a simulator only effects are causes, and their values are those of fits with and without
each (see `shares_beside_base`). With one that would be wrong: each cause has a part of its own to
be found, and such fits give half of the share to an effect that is not there but varies alike.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from tofcorr.diagnosis.findings.causes import Cause
from tofcorr.diagnosis.findings.explained import FLOOR_ERROR, Explained
from tofcorr.diagnosis.findings.hidden import hidden_shares
from tofcorr.diagnosis.findings.how_far import Gap
from tofcorr.diagnosis.findings.parts import Parts, Refitted
from tofcorr.diagnosis.findings.resamples import Interval, hull, interval_of
from tofcorr.diagnosis.findings.shares_beside_base import values_beside_base
from tofcorr.diagnosis.findings.shrinkage import shrinkage_of_values

UNEXPLAINED = Cause(name="unexplained", kind="unexplained")
"""What no cause explains."""


@dataclass(frozen=True, kw_only=True)
class Share:
    """The share of one cause in the square of the gap.

    Attributes:
        cause: `hand_eye`, a group of the base model's terms, an effect, or `unexplained`.
        kind: What sort of cause it is.
        share: All shares sum to one; negative where a cause cancels part of another.
        interval: 95 %.
        of_constant: What a constant over all pixels contributes to the share, whichever cause has
            it; None for causes that have none.
    """

    cause: str
    kind: Literal["parameter", "effect", "unexplained"]
    share: float
    interval: Interval
    of_constant: float | None = None


def attribute(parts: Parts, gap: Gap, weights: Tensor) -> tuple[Share, ...]:
    """Share out the square of the gap as given; without a simulator, of the gap of the base model.

    Args:
        parts: What each cause contributes.
        gap: As given, before and after the effects.
        weights: How often each resample holds each pose, shape (B, U).

    Returns:
        Parameters, effects in the order named, then what is unexplained.
    """
    best = parts.refitted(torch.ones(weights.shape[1], dtype=torch.float64), sparse=True)
    if gap.as_given is None:
        values = _beside_base(parts, gap, weights)
    else:
        values = _as_given(parts, best, gap, gap.as_given, weights)
    return _shares(parts, best, values)


class _Values(NamedTuple):
    """What each cause explains, and of what.

    Attributes:
        own: Value of each cause, shape (causes,), m^2.
        drawn: The same in every resample, (B, causes) each: one or several ways to fit the parts.
        before, after: The gap that is shared out, and what remains of it, metres.
        sizes: Both in every resample.
        unsure: Added in quadrature to either half of an interval, a share each, the unexplained
            last: what resamples do not show.
    """

    own: Tensor
    drawn: Sequence[Tensor]
    before: float
    after: float
    sizes: Sequence[tuple[float, float]]
    unsure: Sequence[float]


def _as_given(parts: Parts, best: Refitted, gap: Gap, as_given: float, weights: Tensor) -> _Values:
    """Return the values of parameters and effects, all fitted together."""
    square = as_given**2 if as_given > 0 else math.inf
    return _Values(
        own=best.values,
        unsure=[*(each / square for each in shrinkage_of_values(parts, best)), 0.0],
        drawn=[
            torch.stack([parts.refitted(w, sparse=sparse).values for w in weights])
            for sparse in (True, False)
        ],
        before=as_given,
        after=gap.after,
        sizes=list(zip(gap.draws.as_given, gap.draws.after, strict=True)),
    )


def _beside_base(parts: Parts, gap: Gap, weights: Tensor) -> _Values:
    """Return the values of effects, by fits with and without each."""
    return _Values(
        own=values_beside_base(parts, torch.ones_like(weights[:1]))[0],
        drawn=[values_beside_base(parts, weights)],
        unsure=[0.0] * (len(parts.causes) + 1),
        before=gap.before,
        after=gap.after,
        sizes=list(zip(gap.draws.before, gap.draws.after, strict=True)),
    )


def _shares(parts: Parts, best: Refitted, values: _Values) -> tuple[Share, ...]:
    """Return the shares of all causes with their intervals."""
    own, rate = scaled_shares(values.own, values.before, values.after)
    drawn = [
        torch.stack([scaled_shares(v, *size)[0] for v, size in zip(of, values.sizes, strict=True)])
        for of in values.drawn
    ]
    constant = 0.0
    if rate is not None:
        constant = best.constant / values.before**2 + rate * abs(best.constant)
    widths = [*hidden_shares(parts, best, float(own[-1])), 0.0]
    found = []
    for place, cause in enumerate((*parts.causes, UNEXPLAINED)):
        share = float(own[place])
        low, high = hull(interval_of(each[:, place].tolist(), share) for each in drawn)
        beside = math.hypot(widths[place], values.unsure[place])
        below, above = (math.hypot(end - share, beside) for end in (low, high))
        if cause.kind == "effect":  # What is unexplained may all belong to it.
            above += float(own[-1])
        found.append(
            Share(
                cause=cause.name,
                kind=cause.kind,
                share=share,
                interval=(share - below, share + above),
                of_constant=constant if parts.constant in cause.members else None,
            )
        )
    return tuple(found)


def explained_squares(parts: Parts, weights: Tensor) -> list[Explained]:
    """Return the mean square that all parts together explain in each resample, B of them."""
    found = []
    for own in weights:
        refitted = parts.refitted(own)
        noise = float((own @ parts.noise) / (own @ parts.counts))
        whole = float(refitted.products[-1, -1])
        explained = float(refitted.values.sum())
        found.append(
            Explained(
                explained=explained,
                least=whole - noise * (1 + FLOOR_ERROR) ** 2,
                most=whole - noise * (1 - FLOOR_ERROR) ** 2,
            )
        )
    return found


def scaled_shares(values: Tensor, total: float, left: float) -> tuple[Tensor, float | None]:
    """Return the shares of all causes and of the unexplained, (causes + 1,).

    Args:
        values: What each cause explains, shape (causes,), m^2.
        total: The gap that is shared out, metres.
        left: What remains of it unexplained, metres.

    Returns:
        The shares; and what a value's size is multiplied by and added to its own share, 1 / m^2,
        None where all is unexplained.
    """
    sizes = values.abs().sum()
    unexplained = min((left / total) ** 2, 1.0) if total > 0 and sizes > 0 else 1.0
    if unexplained == 1.0:
        return torch.cat([0 * values, values.new_ones(1)]), None
    # Held out, the parts explain another share than in the fit. Each takes of the difference what
    # it is of their sizes: in proportion where all help, and bounded where parts cancel.
    rate = float((1 - unexplained - values.sum() / total**2) / sizes)
    shares = values / total**2 + rate * values.abs()
    return torch.cat([shares, values.new_tensor([unexplained])]), rate
