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
together the data do not tell all causes apart. Parameters of the simulator that need no change
have none (`unchanged`); the interval covers the other readings of the data as well.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from tofcorr.diagnosis.findings.causes import Cause
from tofcorr.diagnosis.findings.explained import FLOOR_ERROR, Explained
from tofcorr.diagnosis.findings.how_far import Gap
from tofcorr.diagnosis.findings.parts import PREFERRED, READINGS, Parts, Reading
from tofcorr.diagnosis.findings.resamples import Interval, hull, interval_of

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
    """

    cause: str
    kind: Literal["parameter", "effect", "unexplained"]
    share: float
    interval: Interval


def attribute(parts: Parts, gap: Gap, weights: Tensor) -> tuple[Share, ...]:
    """Share out the square of the gap as given; without a simulator, of the gap of the base model.

    Args:
        parts: What each cause contributes.
        gap: As given, before and after the effects.
        weights: How often each resample holds each pose, shape (B, U).

    Returns:
        Parameters, effects in the order named, then what is unexplained.
    """
    once = torch.ones(1, weights.shape[1], dtype=torch.float64)
    before, draws = gap.before, gap.draws.before
    if gap.as_given is not None:
        before, draws = gap.as_given, gap.draws.as_given
    estimate = _shares(parts, once, [(before, gap.after)], PREFERRED)[0]
    sizes = list(zip(draws, gap.draws.after, strict=True))
    allowed = (PREFERRED,) if gap.as_given is None else READINGS
    readings = [_shares(parts, weights, sizes, reading) for reading in allowed]
    found = []
    for place, cause in enumerate((*parts.causes, UNEXPLAINED)):
        own = float(estimate[place])
        interval = hull(interval_of(drawn[:, place].tolist(), own) for drawn in readings)
        found.append(Share(cause=cause.name, kind=cause.kind, share=own, interval=interval))
    return tuple(found)


def explained_squares(parts: Parts, weights: Tensor) -> list[Explained]:
    """Return the mean square that all parts together explain in each resample, B of them."""
    found = []
    for own in weights:
        products, coefficients = parts.refitted(own)
        noise = float((own @ parts.noise) / (own @ parts.counts))
        whole = float(products[-1, -1])
        explained = float(shapley_values(products, coefficients).sum())
        found.append(
            Explained(
                explained=explained,
                least=whole - noise * (1 + FLOOR_ERROR) ** 2,
                most=whole - noise * (1 - FLOOR_ERROR) ** 2,
            )
        )
    return found


def _shares(
    parts: Parts, weights: Tensor, sizes: Sequence[tuple[float, float]], reading: Reading
) -> Tensor:
    """Return the shares of all causes and of the unexplained in each resample, (B, causes + 1).

    Args:
        parts: What each cause contributes.
        weights: How often each resample holds each pose, shape (B, U).
        sizes: The gap that is shared out, and what remains of it unexplained, metres.
        reading: How the parts are told from one another.
    """
    rows = []
    for own, (total, left) in zip(weights, sizes, strict=True):
        values = shapley_values(*parts.refitted(own, reading))
        explained = float(values.sum())
        unexplained = 1.0
        if total > 0 and explained > 0:
            unexplained = min((left / total) ** 2, 1.0)
            values = values * (1 - unexplained) / explained
        else:
            values = torch.zeros_like(values)
        rows.append(torch.cat([values, values.new_tensor([unexplained])]))
    return torch.stack(rows)


def shapley_values(gram: Tensor, coefficients: Tensor) -> Tensor:
    r"""Return the Shapley value of each part in the fall of the square, shape (K,).

    Args:
        gram: Inner products of the columns and, in the last place, of the residual, (Q, Q).
        coefficients: Of every part over the columns, shape (K, Q - 1).
    """
    whole = coefficients.sum(0)
    # g_k . (r + e), with e = r - sum of all parts.
    return coefficients @ (2 * gram[:-1, -1] - gram[:-1, :-1] @ whole)
