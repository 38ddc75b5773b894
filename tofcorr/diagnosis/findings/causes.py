"""The parts of the gap as given: what each cause contributes in every pixel."""

from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor

from tofcorr.diagnosis.findings.absorption import fitted_coefficients
from tofcorr.diagnosis.findings.naming import NamedEffects
from tofcorr.diagnosis.sums.blocks import EVEN_SD
from tofcorr.diagnosis.sums.prediction import predicted_distance
from tofcorr.diagnosis.sums.study import Study
from tofcorr.error_terms.base import Term
from tofcorr.geometry import se3
from tofcorr.simulation.effects import CATALOGUE

# The group of terms that a constant counts as: no data distinguish it from a constant in another.
_OF_CONSTANT = "distance"
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
        columns: Number of columns that are fitted; columns with the coefficient one follow.
        gram: Inner products of all columns and, in the last place, of the residual, with even
            weights, shape (U, Q, Q), m^2.
        mean: Weighted sum of each column over a pose, shape (U, Q), metres.
        count: Sum of the weights of each pose, shape (U,).
        prior: Prior precision of the fitted columns, in units of `EVEN_SD`.
        constant: Number of the constant's column.
    """

    causes: tuple[Cause, ...]
    columns: int
    gram: Tensor
    mean: Tensor
    count: Tensor
    prior: Tensor
    constant: int

    def fitted(self, weights: Tensor) -> tuple[Tensor, Tensor]:
        """Fit all parts together to some poses.

        Args:
            weights: How often each pose counts, shape (U,).

        Returns:
            Mean products of columns and residual, (Q, Q), and every cause's coefficients over the
            columns, (K, Q - 1).
        """
        count = (weights * self.count).sum()
        gram = torch.einsum("u,uij->ij", weights, self.gram) / count
        mean = (weights @ self.mean) / count
        theta = self._solved(gram, float(weights.sum()))
        coefficients = torch.zeros(len(self.causes), len(gram) - 1, dtype=torch.float64)
        for row, cause in zip(coefficients, self.causes, strict=True):
            members = list(cause.members)
            row[members] = theta[members]
            if cause.fixed is not None:
                row[cause.fixed] = 1.0
            if cause.centred:
                row[self.constant] -= row @ mean[:-1]
        centred = torch.tensor([cause.centred for cause in self.causes], dtype=torch.bool)
        taken = coefficients[centred, self.constant].sum()
        for row, cause in zip(coefficients, self.causes, strict=True):
            if self.constant in cause.members:
                row[self.constant] -= taken
        return gram, coefficients

    def _solved(self, gram: Tensor, poses: float) -> Tensor:
        free = self.columns
        ones = torch.ones(gram.shape[0] - 1 - free, dtype=torch.float64)
        right = gram[:free, -1] - gram[:free, free:-1] @ ones
        # A mean pose weighs as one value known to EVEN_SD, as in the even sums of the study.
        return torch.linalg.solve(gram[:free, :free] + self.prior * EVEN_SD**2 / poses, right)


def parts_of(study: Study, named: NamedEffects, residual: Tensor | None) -> Parts:
    """Return the parts of the residual of a simulator as given.

    Args:
        study: The recording, before any effect was named.
        named: The effects named.
        residual: Of the simulator as given, shape (M,), metres; None: that of the base model, of
            which only effects are causes.
    """
    fit, layout = study.fit, named.study.system.blocks.layout
    members = layout.of(named.columns)
    columns = named.study.system.columns[:, members]
    causes, fixed = _effects(study, named)
    if residual is not None:
        parameters, more = _parameters(study, named)
        causes, fixed = [*parameters, *causes], [*more, *fixed]
    else:
        residual = study.system.residual
    free = columns.shape[1]
    placed, kept = [], []
    for cause, own in zip(causes, fixed, strict=True):
        place = None if own is None else free + len(kept)
        if own is not None:
            kept.append(own[:, None])
        placed.append(replace(cause, fixed=place))
    everything = torch.cat([columns, *kept, residual[:, None]], dim=1)
    gram, mean = _sums(study, everything)
    return Parts(
        causes=tuple(placed),
        columns=free,
        gram=gram,
        mean=mean,
        count=study.system.blocks.count,
        prior=layout.prior_of(members),
        constant=fit.model.num_hand_eye,
    )


def _sums(study: Study, everything: Tensor) -> tuple[Tensor, Tensor]:
    """Return products of all columns and their sums over each pose, evenly weighted."""
    units, size = study.system.blocks.num_units, everything.shape[1]
    gram = torch.zeros(units, size, size, dtype=torch.float64)
    mean = torch.zeros(units, size, dtype=torch.float64)
    for frame, (start, end) in enumerate(study.observations.frame_ends):
        own, share = everything[start:end], study.fit.share[start:end]
        unit = int(study.observations.unit[frame])
        gram[unit] += own.T @ (own * share[:, None])
        mean[unit] += share @ own
    return gram, mean


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
    twist = se3.log(se3.inverse(there) @ here)
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
