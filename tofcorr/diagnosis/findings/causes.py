"""The causes of the gap as given: hand-eye transform, terms of the base model, effects named."""

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

# The cause that a constant counts as: a wall cannot tell whose it is. See `parts`.
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
        offset: What it adds beyond its columns, shape (M,), metres: what is not linear, or was
            estimated otherwise; None: nothing.
        fixed: Number of the column of `offset`, whose coefficient is one.
    """

    name: str
    kind: Literal["parameter", "effect", "unexplained"]
    members: tuple[int, ...] = ()
    offset: Tensor | None = None
    fixed: int | None = None


def causes_of(study: Study, named: NamedEffects, *, parameters: bool) -> list[Cause]:
    """Return the causes; an effect and the base term that it refines are one.

    Args:
        study: The recording, before any effect was named.
        named: The effects named.
        parameters: Whether the simulator's own parameters are causes.
    """
    places = _places(named)
    effects = [
        Cause(
            name=name,
            kind="effect",
            members=tuple(places.get(name, ())),
            offset=_beyond_columns(study, named, name),
        )
        for name in named.names
    ]
    return _merged([*_parameters(study, named, places), *effects]) if parameters else effects


def _parameters(study: Study, named: NamedEffects, places: dict[str, range]) -> list[Cause]:
    """Return hand-eye transform, groups of base terms, and the base model's fixed pattern."""
    model, causes = study.fit.model, []
    constant = model.num_geometry
    if model.num_hand_eye:
        members = tuple(range(model.num_hand_eye))
        causes.append(
            Cause(name=HAND_EYE, kind="parameter", members=members, offset=_beyond_linear(study))
        )
    groups: dict[str, list[int]] = {_OF_CONSTANT: [constant]}
    start = constant + 1
    for term in model.terms:
        end = start + len(term.symbols)
        groups.setdefault(_cause_of(term), []).extend(range(start, end))
        start = end
    for name in named.refined_terms:
        groups.setdefault(name, []).extend(places.get(name, ()))
    causes += [
        Cause(name=name, kind="parameter", members=tuple(members))
        for name, members in groups.items()
    ]
    if study.pattern is not None:
        values = study.fit.residual - study.system.residual
        causes.append(Cause(name=study.pattern.name, kind="parameter", offset=values))
    return causes


def _merged(causes: list[Cause]) -> list[Cause]:
    """Join causes of one name; the last one gives the kind."""
    joined: dict[str, Cause] = {}
    for cause in causes:
        before = joined.pop(cause.name, None)
        if before is not None:
            cause = replace(cause, members=(*before.members, *cause.members))  # noqa: PLW2901
        joined[cause.name] = cause
    return list(joined.values())


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
    twist = twist_of(study)
    return whole - study.system.columns.base[:, : len(twist)] @ twist


def twist_of(study: Study) -> Tensor:
    """Return the change from the simulator's hand-eye transform to the fitted one; none if held."""
    known = study.fit.known
    if known is None or not study.fit.model.num_hand_eye:
        return torch.zeros(0, dtype=torch.float64)
    return se3.log(se3.inverse(known.tool_from_camera) @ study.fit.tool_from_camera)


def _places(named: NamedEffects) -> dict[str, range]:
    """Return the places of the named effects' columns among those of the model."""
    layout = named.study.system.blocks.layout.only(named.columns)
    return {name: range(*place) for name, place in layout.effects.items()}


def _beyond_columns(study: Study, named: NamedEffects, name: str) -> Tensor | None:
    """Return a named map's values, or what an effect adds beyond its columns, (M,), metres."""
    if name in named.maps:
        return named.maps[name]
    effect = study.candidates.effects[name]
    if effect.linear:
        return None
    bent = [n for n in named.columns if not study.candidates.effects[n].linear]
    if bent == [name]:
        # What the fit itself subtracted: its last linearisation, not a step beyond it, where a
        # signal near saturation may jump.
        kept = named.study.system.residual + sum(named.maps.values())
        return study.system.residual - kept
    own = fitted_coefficients(named.study, named.columns)[name]
    slope = named.study.system.columns.effects[name]
    return effect.shift(study.inputs, own) - slope @ (own / effect.prior_sd())
