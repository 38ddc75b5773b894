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
together the data do not tell all causes apart, and the intervals cover the last three of these:

- Whose a constant is. A wall at an unknown place cannot tell: it may be that of the camera, of a
  shift along its axis, or the mean of an effect. So the mean of every part over all pixels counts
  as `distance`, and all other parts have mean zero. The constant itself is then the mean of the
  residual, which needs no model.
- Whether a parameter of the simulator needs a change (`unchanged`).
- What of an effect its model misses (`hidden_shares`).
- How effects that vary alike share what they add (`shrinkage_of_values`).

Without a simulator only effects are causes, and their values are those of fits with and without
each (`values_beside_base`). With one that would be wrong: each cause has a part of its own to be
found, and such fits give half of the share to an effect that is not there but varies alike.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import chain, combinations
from math import comb
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from tofcorr.diagnosis.findings.gap import Gap
from tofcorr.diagnosis.findings.naming import NamedEffects
from tofcorr.diagnosis.findings.where import Estimated, interval_of
from tofcorr.diagnosis.sums.linear_system import BASE
from tofcorr.diagnosis.sums.noise import FLOOR_ERROR
from tofcorr.diagnosis.sums.observations import predicted_distance
from tofcorr.diagnosis.sums.study import Study, fitted_coefficients, hidden_effects
from tofcorr.error_terms.base import Term
from tofcorr.estimation.robust import LEVEL, student_quantile
from tofcorr.simulation.effects import CATALOGUE

# The cause that a constant counts as: a wall cannot tell whose it is.
_OF_CONSTANT = "distance"
HAND_EYE = "hand_eye"
"""The name of the hand-eye transform as a cause."""
TWO_SIDED = student_quantile(1 - LEVEL / 2, math.inf)
"""Standard errors from a normal estimate to either end of its interval."""


@dataclass(frozen=True)
class Share:
    """One cause of the gap, and its share in the square of the gap.

    Attributes:
        cause: `hand_eye`, a group of the base model's terms, an effect, or `unexplained`.
        kind: Parameter of the simulator, effect, or the unexplained.
        members: Numbers of its columns.
        offset: What it adds beyond its columns, shape (M,), metres: what is not linear, or was
            estimated otherwise; None: nothing.
        fixed: Number of the column of `offset`, whose coefficient is one.
        share: All shares sum to one; negative where a cause cancels part of another.
        of_constant: What a constant over all pixels contributes to the share, whichever cause has
            it; None for causes that have none.
    """

    cause: str
    kind: Literal["parameter", "effect", "unexplained"]
    members: tuple[int, ...] = ()
    offset: Tensor | None = None
    fixed: int | None = None
    share: Estimated = field(default_factory=Estimated)
    of_constant: float | None = None


def alike(study: Study, cause: str) -> list[str]:
    """Return the causes that look the same as one in this recording.

    They are the hand-eye transform and the effects of which calibration leaves hardly anything,
    but for finer forms of base terms.
    """
    model, hidden = study.fit.model, hidden_effects(study)
    hidden = [name for name in hidden if model.groups.isdisjoint(CATALOGUE[name].refines)]
    hidden = hidden if model.num_hand_eye else []
    if cause == HAND_EYE:
        return hidden
    return [HAND_EYE] if cause in hidden else []


def causes_of(study: Study, named: NamedEffects, *, parameters: bool) -> list[Share]:
    """Return the causes; an effect and the base term that it refines are one.

    Args:
        study: The recording, before any effect was named.
        named: The effects named.
        parameters: Whether the simulator's own parameters are causes.
    """
    layout, model = named.study.sums.layout.only(named.columns), study.fit.model
    places = {name: tuple(range(*place)) for name, place in layout.effects.items()}
    members: dict[str, tuple[int, ...]] = {}
    offsets: dict[str, Tensor | None] = {}
    if parameters:
        if model.num_hand_eye:
            members[HAND_EYE], offsets[HAND_EYE] = (*range(model.num_hand_eye),), _bent(study)
        members[_OF_CONSTANT] = (model.num_geometry,)
        start = model.num_geometry + 1
        for term in model.error_model.terms():
            name, end = _cause_of(term), start + len(term.symbols)
            members[name] = (*members.get(name, ()), *range(start, end))
            start = end
        if study.pattern is not None:
            members.setdefault(study.pattern.name, ())
            offsets[study.pattern.name] = study.fit.residual - study.residual
    for name in named.names:  # They come last.
        members[name] = (*members.pop(name, ()), *places.get(name, ()))
        offsets[name] = _beyond_columns(study, named, name)
    return [
        Share(name, "effect" if name in named.names else "parameter", own, offsets.get(name))
        for name, own in members.items()
    ]


def _cause_of(term: Term) -> str:
    """Return the name of a term as a cause: that of the effect it describes, if there is one."""
    if term.options.kind in CATALOGUE:
        return term.options.kind
    known = (name for name, effect in CATALOGUE.items() if term.group in effect.refines)
    return next(known, term.group)


def _bent(study: Study) -> Tensor | None:
    """Return what a change of the hand-eye transform adds beyond its columns, (M,), metres."""
    known, pose = study.fit.known, study.fit.tool_from_camera
    if known is None:
        return None
    here, there = (
        predicted_distance(study.observations, p) for p in (pose, known.tool_from_camera)
    )
    twist = known.twist_to(pose)
    return here - there - study.columns[BASE][:, : len(twist)] @ twist


def _beyond_columns(study: Study, named: NamedEffects, name: str) -> Tensor | None:
    """Return a named map's values, or what an effect adds beyond its columns, (M,), metres."""
    if name in named.maps:
        return named.maps[name]
    effects = study.effects
    if effects[name].linear:
        return None
    if [n for n in named.columns if not effects[n].linear] == [name]:
        # What the fit itself subtracted: its last linearisation, not a step beyond it, where a
        # signal near saturation may jump.
        kept = named.study.residual + sum(named.maps.values())
        return study.residual - kept
    own = fitted_coefficients(named.study, named.columns)[name]
    slope = named.study.columns[name]
    return effects[name].shift(study.inputs, own) - slope @ (own / effects[name].prior_sd())


def held_solution(normal: Tensor, score: Tensor, start: Tensor, held: Sequence[int]) -> Tensor:
    """Fit all columns but those held; return how far each is from the simulator's, shape (K,).

    Args:
        normal: Sum of A_u and prior precision, shape (K, K).
        score: Sum of b_u, shape (K,).
        start: From the simulator to the base fit, shape (K,).
        held: Numbers of the columns that stay as the simulator has them.
    """
    free = torch.ones(len(start), dtype=torch.bool)
    free[list(held)] = False
    own = normal[free]
    found = torch.zeros_like(start)
    right = score[free] + own[:, ~free] @ start[~free]
    found[free] = start[free] + torch.linalg.solve(own[:, free], right)
    return found


def unchanged(
    normal: Tensor,
    score: Tensor,
    start: Tensor,
    groups: Mapping[str, Sequence[int]],
    least: Mapping[str, float],
) -> frozenset[str]:
    """Return the parameters that need no change: one by one, the least needed first.

    Args:
        normal: Sum of A_u and prior precision, shape (K, K).
        score: Sum of b_u, shape (K,).
        start: From the simulator to the base fit, shape (K,).
        groups: Columns of each parameter that may stay as it is.
        least: What a change of each must close, in the unit of `normal`.
    """
    best, covariance = held_solution(normal, score, start, ()), torch.linalg.inv(normal)

    def excess(columns: Sequence[int]) -> float:
        own = torch.tensor(columns, dtype=torch.int64)
        return float(best[own] @ torch.linalg.solve(covariance[own][:, own], best[own]))

    others, columns = dict(groups), list[int]()
    while others:
        base = excess(columns)
        needed = {n: (excess([*columns, *own]) - base) / least[n] for n, own in others.items()}
        name = min(needed, key=lambda each: needed[each])
        if needed[name] >= 1:
            break
        columns += others.pop(name)
    return frozenset(groups.keys() - others.keys())


@dataclass(frozen=True, kw_only=True)
class Parts:
    """Columns of all causes and their sums over each pose.

    Attributes:
        causes: The causes whose shares are wanted.
        products: Of all columns, the residual, and ones in the last place, with every pixel
            counting as it does in the gap that is shared out, shape (U, Q + 1, Q + 1), metres where
            a column meets ones, m^2 where columns meet. Columns that are fitted come first, then
            those with the coefficient one.
        noise: Sum of the variances of a pose's pixels, shape (U,), m^2.
        start: Coefficients of the fitted columns that lead from the simulator to the base fit.
        fitted: A_u, b_u and the prior precision of what the final model adds to them.
        prior: That precision in the unit of `products`, m^2.
        constant: Number of the constant's column.
        least: What a change of each parameter must close for each pose, in the unit of `fitted`,
            (U,).
    """

    causes: tuple[Share, ...]
    products: Tensor
    noise: Tensor
    start: Tensor
    fitted: tuple[Tensor, Tensor, Tensor]
    prior: Tensor
    constant: int
    least: dict[str, Tensor]

    def refitted(self, weights: Tensor, *, sparse: bool = False) -> "Refitted":
        """Fit all parts together to some poses.

        Args:
            weights: How often each pose counts, shape (U,).
            sparse: Whether parameters of the simulator stay as they are unless the data require a
                change.
        """
        products = torch.tensordot(weights, self.products, dims=1)
        products = products / products[-1, -1]
        gram, score, prior = self.fitted
        normal, right = torch.tensordot(weights, gram, dims=1) + prior, weights @ score
        held: frozenset[str] = frozenset()
        groups = {c.cause: c.members for c in self.causes if c.cause in self.least and c.members}
        if sparse and groups:
            least = {name: float(weights @ self.least[name]) for name in groups}
            held = unchanged(normal, right, self.start, groups, least)
        columns = [column for name in held for column in groups[name]]
        theta = held_solution(normal, right, self.start, columns)
        coefficients = torch.zeros(len(self.causes), len(products) - 2, dtype=torch.float64)
        coefficients[:, : len(theta)] = self.owned * theta
        for row, cause in zip(coefficients, self.causes, strict=True):
            if cause.fixed is not None and cause.cause not in held:
                row[cause.fixed] = 1.0
        owner = [self.constant in cause.members for cause in self.causes]
        if any(owner):
            mean = coefficients @ products[-1, :-2]
            mean[owner.index(True)] -= mean.sum()
            coefficients[:, self.constant] -= mean
        return Refitted(products, coefficients)

    @cached_property
    def owned(self) -> Tensor:
        """One where a fitted column belongs to a cause, else zero, (causes, columns)."""
        owned = torch.zeros(len(self.causes), len(self.start), dtype=torch.float64)
        for row, cause in zip(owned, self.causes, strict=True):
            row[list(cause.members)] = 1.0
        return owned


class Refitted(NamedTuple):
    """All parts, fitted to some poses.

    Attributes:
        products: Mean products of columns, the residual and ones, shape (Q + 1, Q + 1).
        coefficients: Of every part over the columns, shape (K, Q - 1).
    """

    products: Tensor
    coefficients: Tensor

    @property
    def values(self) -> Tensor:
        """Shapley value of each part in the fall of the square, shape (K,), m^2."""
        return shapley_values(self.products[:-1, :-1], self.coefficients)

    @property
    def centred(self) -> Tensor:
        """Covariances of columns and, in the last place, of the residual, shape (Q, Q), m^2."""
        means = self.products[-1, :-1]
        return self.products[:-1, :-1] - means[:, None] * means

    @property
    def constant(self) -> float:
        """What a constant over all pixels contributes to the value of the part that has it, m^2."""
        mean = self.coefficients.sum(0) @ self.products[-1, :-2]
        return float(mean * (2 * self.products[-1, -2] - mean))


def shapley_values(gram: Tensor, coefficients: Tensor) -> Tensor:
    r"""Return the Shapley value of each part in the fall of the square, shape (K,).

    Args:
        gram: Inner products of the columns and, in the last place, of the residual, (Q, Q).
        coefficients: Of every part over the columns, shape (K, Q - 1).
    """
    # g_k . (r + e), with e = r - sum of all parts.
    return coefficients @ (2 * gram[:-1, -1] - gram[:-1, :-1] @ coefficients.sum(0))


def parts_of(study: Study, named: NamedEffects, residual: Tensor | None) -> Parts:
    """Return the parts of the residual of a simulator as given.

    A base term changes only if that closes a tenth of the target gap. The hand-eye transform needs
    as much as a second effect: it resembles most what models miss.

    Args:
        study: The recording, before any effect was named.
        named: The effects named.
        residual: Of the simulator as given, shape (M,), metres; None: that of the base model, of
            which only effects are causes.
    """
    model, sums, tests = study.fit.model, named.study.sums.ols, study.options.tests
    fitted, columns = sums.of(named.columns), named.study.columns_of(named.columns)
    start = torch.zeros(len(fitted[2]), dtype=torch.float64)
    # The gap as given is of all pixels alike; after recalibration noisy ones count less.
    weight, shared, known = study.fit.trust, residual, study.fit.known
    if shared is None or known is None:
        shared, weight = study.residual, study.fit.share
    else:
        twist = known.twist_to(study.fit.tool_from_camera)
        start[: model.num_hand_eye] = twist[: model.num_hand_eye]
        start[model.num_geometry : model.num_columns] = study.fit.coefficients
    causes = list[Share]()
    for cause in causes_of(study, named, parameters=residual is not None):
        fixed = None
        if cause.offset is not None:
            fixed = sum(part.shape[1] for part in columns)
            columns.append(cause.offset[:, None])
        causes.append(replace(cause, fixed=fixed))
    everything = torch.cat([*columns, shared[:, None], torch.ones_like(shared[:, None])], dim=1)
    gap = study.left_out_mean_square(()) - study.fit.floor**2
    second = max((tests.further_mm / 1000) ** 2, tests.material_share * gap)
    pose = sums.scale * study.sums.count
    least = min(second, (study.options.target_gap_mm / 10_000) ** 2)
    return Parts(
        causes=tuple(causes),
        products=study.observations.products(everything, everything * weight[:, None]),
        noise=torch.bincount(study.unit_of_pixel, weight * study.fit.sigma**2, len(pose)),
        start=start,
        fitted=fitted,
        prior=fitted[2] / sums.scale,
        constant=model.num_geometry,
        least={
            cause.cause: pose * (second if cause.cause == HAND_EYE else least)
            for cause in causes
            if cause.kind == "parameter"
        },
    )


def hidden_shares(parts: Parts, refitted: Refitted, unexplained: float) -> list[float]:
    """Return by how much each cause's share may be too small or too large, 95 %.

    Args:
        parts: What each cause contributes.
        refitted: The same, fitted to all poses.
        unexplained: The share that is unexplained.
    """
    centred, whole, widths = refitted.centred, float(refitted.products[-2, -2]), []
    if whole <= 0:
        return [0.0] * len(parts.causes)
    reach = TWO_SIDED * math.sqrt(unexplained / (len(centred) - 1) / whole)
    for cause in parts.causes:
        known = square = float(centred[-1, -1])
        if cause.kind == "parameter":
            own = [*cause.members, *([] if cause.fixed is None else [cause.fixed])]
            inverse, right = torch.linalg.pinv(centred[own][:, own]), centred[own, -1]
            known = min(float(right @ inverse @ right), square)
        widths.append(reach * math.sqrt(max(known, 0.0)))
    return widths


def shrinkage_of_values(parts: Parts, refitted: Refitted) -> list[float]:
    """Return by how much the prior may have moved the value of each cause, 95 %, m^2.

    Args:
        parts: What each cause contributes.
        refitted: The same, fitted to all poses.
    """
    gram, _, prior = parts.fitted
    covariance = torch.linalg.inv(gram.sum(0) + prior)
    covariance, fitted = covariance @ prior @ covariance, len(covariance)
    # Every part has mean zero but that of the constant, which the data determine.
    inner, right = refitted.centred[:-1, :-1], refitted.centred[:-1, -1]
    rest = 2 * right - inner @ refitted.coefficients.sum(0)
    slopes = (parts.owned * rest[:fitted]) - (refitted.coefficients @ inner)[:, :fitted]
    variances = torch.einsum("kp,pq,kq->k", slopes, covariance, slopes)
    return (TWO_SIDED * variances.clamp(min=0).sqrt()).tolist()


def values_beside_base(parts: Parts, weights: Tensor) -> Tensor:
    """Return the Shapley value of every effect in some resamples, shape (B, K), m^2.

    Args:
        parts: Columns and sums; all causes are effects.
        weights: How often each resample holds each pose, shape (B, U).
    """
    products = torch.tensordot(weights, parts.products, dims=1)
    count, every = len(parts.causes), range(len(parts.causes))
    subsets = chain.from_iterable(combinations(every, size) for size in range(count + 1))
    left = {chosen: _left(parts, products, [parts.causes[k] for k in chosen]) for chosen in subsets}
    values = torch.zeros(len(weights), count, dtype=torch.float64)
    for before, more in left.items():
        for effect in set(every) - set(before):
            less = left[tuple(sorted((*before, effect)))]
            values[:, effect] += (more - less) / (count * comb(count - 1, len(before)))
    return values / products[:, -1:, -1]


def _left(parts: Parts, products: Tensor, causes: list[Share]) -> Tensor:
    """Return the sum of squares that base model and some effects leave, shape (B,), m^2.

    Args:
        parts: Columns and sums.
        products: As in `Parts`, of each resample, shape (B, Q + 1, Q + 1).
        causes: The effects.
    """
    base = (parts.owned.sum(0) == 0).nonzero()[:, 0].tolist()
    fitted = [*base, *chain.from_iterable(cause.members for cause in causes)]
    # The residual less what the effects add with a coefficient of one.
    rest = torch.zeros(products.shape[-1], dtype=torch.float64)
    rest[-2] = 1.0
    rest[[cause.fixed for cause in causes if cause.fixed is not None]] = -1.0
    right = products @ rest
    square, right = right @ rest, right[:, fitted]
    gram = products[:, fitted][:, :, fitted]
    theta = torch.linalg.solve(gram + parts.prior[fitted][:, fitted], right)
    return square - (theta * (2 * right - (gram @ theta[..., None])[..., 0])).sum(1)


def attribute(parts: Parts, gap: Gap, weights: Tensor) -> tuple[Share, ...]:
    """Share out the square of the gap as given; without a simulator, of the gap of the base model.

    Args:
        parts: What each cause contributes.
        gap: As given, before and after the effects.
        weights: How often each resample holds each pose, shape (B, U).

    Returns:
        Parameters, effects in the order named, then what is unexplained.
    """
    once, total = torch.ones_like(weights[:1]), gap.whole
    best = parts.refitted(once[0], sparse=True)
    shrunk = [0.0] * len(parts.causes)
    if gap.as_given is None:
        own, drawn = values_beside_base(parts, once)[0], [values_beside_base(parts, weights)]
    else:
        own = best.values
        both = ([parts.refitted(w, sparse=sparse) for w in weights] for sparse in (True, False))
        drawn = [torch.stack([one.values for one in fits]) for fits in both]
        if total > 0:
            shrunk = [width / total**2 for width in shrinkage_of_values(parts, best)]
    shares, rate = scaled_shares(own, total, gap.after)
    draws = []
    for values in drawn:
        rows = zip(values, total.draws, gap.after.draws, strict=True)
        draws.append(torch.stack([scaled_shares(*row)[0] for row in rows]))
    constant = 0.0
    if rate is not None:
        constant = best.constant / total**2 + rate * abs(best.constant)
    unexplained = float(shares[-1])
    # What resamples do not show is added in quadrature to either half of an interval.
    beside = [*map(math.hypot, hidden_shares(parts, best, unexplained), shrunk), 0.0]
    found = []
    for place, cause in enumerate((*parts.causes, Share("unexplained", "unexplained"))):
        share = float(shares[place])
        ends = [end for each in draws for end in interval_of(each[:, place].tolist(), share)]
        below, above = (math.hypot(end - share, beside[place]) for end in (min(ends), max(ends)))
        if cause.kind == "effect":  # What is unexplained may all belong to it.
            above += unexplained
        estimated = Estimated(share, interval=(share - below, share + above))
        of_constant = constant if parts.constant in cause.members else None
        found.append(replace(cause, offset=None, share=estimated, of_constant=of_constant))
    return tuple(found)


def explained_squares(parts: Parts, weights: Tensor) -> Tensor:
    """Return what all parts together explain of the residual as given, (1 + B, 3), m^2.

    Of all poses, then in every resample.
    The first is the mean square explained. What is explained and what is left together lie between
    the other two: the mean square of the residual less that of the noise, which is known to
    `FLOOR_ERROR`.
    """
    weights = torch.cat([torch.ones_like(weights[:1]), weights])
    explained = torch.stack([parts.refitted(own).values.sum() for own in weights])
    whole, noise = weights @ parts.products[:, -2, -2], weights @ parts.noise
    limits = [whole - noise * (1 + sign * FLOOR_ERROR) ** 2 for sign in (1, -1)]
    return torch.stack([explained, *(x / (weights @ parts.products[:, -1, -1]) for x in limits)], 1)


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
