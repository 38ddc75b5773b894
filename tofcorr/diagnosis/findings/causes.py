"""The parts of the gap as given: what each cause contributes in every pixel."""

from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor

from tofcorr.diagnosis.findings.absorption import fitted_coefficients
from tofcorr.diagnosis.findings.naming import NamedEffects
from tofcorr.diagnosis.sums.prediction import predicted_distance
from tofcorr.diagnosis.sums.study import Study
from tofcorr.error_terms.base import Term
from tofcorr.geometry import se3
from tofcorr.simulation.effects import CATALOGUE

# The group of terms that a constant counts as: no data distinguish it from a constant in another.
_OF_CONSTANT = "distance"
# An effect that reproduces this share of a constant is taken to reproduce it: its own mean says
# nothing then, and counts as a constant. Chosen; a warm-up reaches 0.95, an offset 1.
_HOLDS_CONSTANT = 0.8
# Added to the diagonal of an effect's products, as a share of its mean, so that they are regular.
_RIDGE = 1e-6
HAND_EYE = "hand_eye"
"""The name of the hand-eye transform as a cause."""


@dataclass(frozen=True, kw_only=True)
class Cause:
    """One cause of the gap.

    Attributes:
        name: As in `diagnosis.json`.
        kind: Parameter of the simulator, effect, or the unexplained.
        members: Numbers of its columns.
        fixed: Number of the column that has the coefficient one: what is not linear, or was
            estimated otherwise; None: there is none.
        centred: Whether its mean over all pixels counts as a constant.
    """

    name: str
    kind: Literal["parameter", "effect", "unexplained"]
    members: tuple[int, ...] = ()
    fixed: int | None = None
    centred: bool = False


@dataclass(frozen=True, kw_only=True)
class Parts:
    """Columns of all causes and their sums over each pose.

    Attributes:
        causes: The causes whose shares are wanted.
        products: Of all columns and, in the last place, of the residual, every pixel counting
            alike, shape (U, Q, Q), m^2. Columns that are fitted come first, then those with the
            coefficient one.
        means: Sum of each column over a pose, shape (U, Q), metres.
        counts: Pixels of each pose, shape (U,).
        start: Coefficients of the fitted columns that lead from the simulator to the base fit.
        fitted: A_u, b_u and the prior precision of what the final model adds to them.
        constant: Number of the constant's column.
    """

    causes: tuple[Cause, ...]
    products: Tensor
    means: Tensor
    counts: Tensor
    start: Tensor
    fitted: tuple[Tensor, Tensor, Tensor]
    constant: int

    def refitted(self, weights: Tensor) -> tuple[Tensor, Tensor]:
        """Fit all parts together to some poses.

        Args:
            weights: How often each pose counts, shape (U,).

        Returns:
            Mean products of columns and residual, (Q, Q), and every cause's coefficients over the
            columns, (K, Q - 1).
        """
        count = (weights * self.counts).sum()
        products = torch.einsum("u,uij->ij", weights, self.products) / count
        means = (weights @ self.means)[:-1] / count
        gram, score, prior = self.fitted
        normal = torch.einsum("u,uij->ij", weights, gram) + prior
        theta = self.start + torch.linalg.solve(normal, weights @ score)
        coefficients = torch.zeros(len(self.causes), len(means), dtype=torch.float64)
        for row, cause in zip(coefficients, self.causes, strict=True):
            row[list(cause.members)] = theta[list(cause.members)]
            if cause.fixed is not None:
                row[cause.fixed] = 1.0
            if cause.centred:
                row[self.constant] -= row @ means
        centred = torch.tensor([cause.centred for cause in self.causes], dtype=torch.bool)
        taken = coefficients[centred, self.constant].sum()
        for row, cause in zip(coefficients, self.causes, strict=True):
            if self.constant in cause.members:
                row[self.constant] -= taken
        return products, coefficients


def parts_of(study: Study, named: NamedEffects, residual: Tensor | None) -> Parts:
    """Return the parts of the residual of a simulator as given.

    Args:
        study: The recording, before any effect was named.
        named: The effects named.
        residual: Of the simulator as given, shape (M,), metres; None: that of the base model, of
            which only effects are causes.
    """
    model, sums = study.fit.model, named.study.system.blocks.even
    members = sums.layout.of(named.columns)
    columns = named.study.system.columns[:, members]
    causes, fixed = _effects(study, named)
    start = torch.zeros(len(members), dtype=torch.float64)
    if residual is None:
        residual = study.system.residual
    else:
        parameters, more = _parameters(study, named)
        causes, fixed = _merged([*parameters, *causes], [*more, *fixed])
        known = torch.cat([_twist(study), study.fit.coefficients])
        start[: len(known)] = known
    free, kept = len(members), [own[:, None] for own in fixed if own is not None]
    for place, own in enumerate(fixed):
        if own is not None:
            number = free + sum(other is not None for other in fixed[:place])
            causes[place] = replace(causes[place], fixed=number)
    products, means, counts = _sums(study, torch.cat([columns, *kept, residual[:, None]], dim=1))
    share = means[:, :free].sum(0) / counts.sum()
    inner = products[:, :free, :free].sum(0) / counts.sum()
    causes = [
        cause if cause.centred else replace(cause, centred=_holds_constant(cause, share, inner))
        for cause in causes
    ]
    return Parts(
        causes=tuple(causes),
        products=products,
        means=means,
        counts=counts,
        start=start,
        fitted=sums.of(named.columns),
        constant=model.num_hand_eye,
    )


def _holds_constant(cause: Cause, means: Tensor, inner: Tensor) -> bool:
    """Return whether an effect can describe a constant, so that its own mean says nothing."""
    if cause.kind != "effect" or not cause.members:
        return False
    own = torch.tensor(cause.members)
    gram = inner[own][:, own]
    gram = gram + _RIDGE * gram.diagonal().mean() * torch.eye(len(own), dtype=torch.float64)
    return float(means[own] @ torch.linalg.solve(gram, means[own])) > _HOLDS_CONSTANT


def _merged(
    causes: list[Cause], fixed: list[Tensor | None]
) -> tuple[list[Cause], list[Tensor | None]]:
    """Join an effect with the base term that it refines: one name, one cause."""
    places = {cause.name: place for place, cause in enumerate(causes)}
    found: list[Cause] = []
    rest: list[Tensor | None] = []
    for place, cause in enumerate(causes):
        last = places[cause.name]
        if place == last:
            same = [other for other in causes if other.name == cause.name]
            members = tuple(number for other in same for number in other.members)
            centred = any(other.centred for other in same)
            found.append(replace(cause, members=members, centred=centred))
            rest.append(fixed[place])
    return found, rest


def _sums(study: Study, everything: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return products of all columns, their sums, and the pixels of each pose."""
    units, size = study.system.blocks.num_units, everything.shape[1]
    products = torch.zeros(units, size, size, dtype=torch.float64)
    means = torch.zeros(units, size, dtype=torch.float64)
    counts = torch.zeros(units, dtype=torch.float64)
    for frame, (start, end) in enumerate(study.observations.frame_ends):
        own, trust = everything[start:end], study.fit.trust[start:end]
        unit = int(study.observations.unit[frame])
        products[unit] += own.T @ (own * trust[:, None])
        means[unit] += trust @ own
        counts[unit] += trust.sum()
    return products, means, counts


def _twist(study: Study) -> Tensor:
    """Return the change from the simulator's hand-eye transform to the fitted one; none if held."""
    known = study.fit.known
    if known is None or not study.fit.model.num_hand_eye:
        return torch.zeros(0, dtype=torch.float64)
    return se3.log(se3.inverse(known.tool_from_camera) @ study.fit.tool_from_camera)


def _parameters(study: Study, named: NamedEffects) -> tuple[list[Cause], list[Tensor | None]]:
    """Return hand-eye transform and groups of base terms, and what of each is fixed."""
    model = study.fit.model
    causes: list[Cause] = []
    fixed: list[Tensor | None] = []
    count = model.num_hand_eye
    if count:
        causes.append(Cause(name=HAND_EYE, kind="parameter", members=tuple(range(count))))
        fixed.append(_beyond_linear(study))
    groups: dict[str, list[int]] = {_OF_CONSTANT: [count]}
    start = count + 1
    for term in model.terms:
        end = start + len(term.symbols)
        groups.setdefault(_cause_of(term), []).extend(range(start, end))
        start = end
    refined = _places(named)
    for name in named.refined_terms:
        if name in refined:
            groups.setdefault(name, []).extend(refined[name])
    for name, members in groups.items():
        centred = name != _OF_CONSTANT
        causes.append(Cause(name=name, kind="parameter", members=tuple(members), centred=centred))
        fixed.append(None)
    if study.pattern is not None:
        causes.append(Cause(name=study.pattern.name, kind="parameter", centred=True))
        fixed.append(study.fit.residual - study.system.residual)
    return causes, fixed


def _cause_of(term: Term) -> str:
    """Return the name of a term as a cause: that of the effect it describes, if there is one."""
    if term.options.kind in CATALOGUE:
        return term.options.kind
    known = (name for name, effect in CATALOGUE.items() if term.group in effect.refines)
    return next(known, term.group)


def _beyond_linear(study: Study) -> Tensor | None:
    """Return what a change of the hand-eye transform adds beyond its columns, (M,), metres."""
    known = study.fit.known
    if known is None:
        return None
    here, there = study.fit.tool_from_camera, known.tool_from_camera
    observations = study.observations
    whole = predicted_distance(observations, here) - predicted_distance(observations, there)
    twist = _twist(study)
    return whole - study.system.columns[:, : len(twist)] @ twist


def _effects(study: Study, named: NamedEffects) -> tuple[list[Cause], list[Tensor | None]]:
    places = _places(named)
    causes: list[Cause] = []
    fixed: list[Tensor | None] = []
    for name in named.names:
        causes.append(Cause(name=name, kind="effect", members=tuple(places.get(name, ()))))
        fixed.append(_fixed_part(study, named, name))
    return causes, fixed


def _places(named: NamedEffects) -> dict[str, range]:
    """Return the places of the named effects' columns among those of the model."""
    layout = named.study.system.blocks.layout.only(named.columns)
    return {name: range(*place) for name, place in layout.effects.items()}


def _fixed_part(study: Study, named: NamedEffects, name: str) -> Tensor | None:
    """Return a named map's values, or what an effect adds beyond its columns, (M,), metres."""
    if name in named.maps:
        return named.maps[name]
    effect = study.candidates.effects[name]
    if effect.linear:
        return None
    own = fitted_coefficients(named.study, named.columns)[name]
    low, high = named.study.system.blocks.layout.effects[name]
    slope = named.study.system.columns[:, low:high]
    return effect.shift(study.inputs, own) - slope @ (own / effect.prior_sd())
