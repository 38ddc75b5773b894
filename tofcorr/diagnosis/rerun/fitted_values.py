"""The parameters that a diagnosis fitted, with units and intervals: what sensor.yaml holds."""

import copy
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from tofcorr.diagnosis.findings.gap import Interval, interval_of
from tofcorr.diagnosis.findings.naming import NamedEffects
from tofcorr.diagnosis.findings.shares import HAND_EYE
from tofcorr.diagnosis.rerun.fitted_simulator import fitted_effects
from tofcorr.diagnosis.rerun.found_sensor import given_error
from tofcorr.diagnosis.sums.study import Study
from tofcorr.geometry import se3
from tofcorr.simulation.effects import MapEffect

_DEGREES = 180 / torch.pi


@dataclass(frozen=True, kw_only=True)
class FittedValue:
    """One parameter of the final model.

    Attributes:
        cause: `hand_eye`, a group of the base model's terms, or an effect.
        kind: `parameter` or `effect`.
        name: Its symbol, as in sensor.yaml.
        unit: As in sensor.yaml.
        value: The estimate.
        interval: 95 %, with poses as the unit; None for a map, of which the size is given.
    """

    cause: str
    kind: str
    name: str
    unit: str
    value: float
    interval: Interval | None


def fitted_values(
    study: Study,
    named: NamedEffects,
    given_effects: Sequence[Mapping[str, Any]],
    resamples: Tensor,
) -> tuple[FittedValue, ...]:
    """Return hand-eye transform, coefficients of the base terms, and those of the named effects.

    Args:
        study: The recording, before any effect was named.
        named: The effects named.
        given_effects: Those of the built-in simulator under diagnosis; empty where there is none.
        resamples: How often each resample holds each pose, shape (B, U).
    """
    sums = named.study.sums.ols
    gram, score, prior = sums.of(named.columns)
    normal = torch.tensordot(resamples, gram, dims=1) + prior
    draws = torch.linalg.solve(normal, (resamples @ score)[..., None])[..., 0]
    thetas = torch.cat([sums.solve(named.columns)[None], draws])
    return (
        *_values(HAND_EYE, "parameter", _hand_eye(study, thetas)),
        *_base_terms(study, thetas, given_error(study, given_effects)[0]),
        *_effects(study, named, thetas),
    )


def _hand_eye(study: Study, thetas: Tensor) -> list[tuple[str, str, list[float]]]:
    count = study.fit.model.num_hand_eye
    if not count:
        return []
    poses = study.fit.tool_from_camera @ se3.exp(thetas[:, :count])
    found = torch.cat([1e3 * poses[:, :3, 3], _DEGREES * se3.log(poses)[:, 3:]], dim=1)
    names = [f"tool_from_camera, {axis}" for axis in "xyz"]
    names += [f"rotation vector, {axis}" for axis in "xyz"]
    units = ["mm"] * 3 + ["deg"] * 3
    return list(zip(names, units, found.T.tolist(), strict=True))


def _base_terms(study: Study, thetas: Tensor, given: Tensor) -> list[FittedValue]:
    model, drawn = study.fit.model, []
    error = copy.deepcopy(model.error_model)
    whole = study.fit.coefficients + given
    for own in whole + thetas[:, model.num_geometry : model.num_columns]:
        error.set_coefficient_vector(own)
        drawn.append(error.paper_coefficients())
    found, units = [], error.paper_units()
    for group, values in drawn[0].items():
        parts = [(name, units[group][name], [one[group][name] for one in drawn]) for name in values]
        found += _values(group, "parameter", parts)
    return found


def _effects(study: Study, named: NamedEffects, thetas: Tensor) -> list[FittedValue]:
    layout, found = named.study.sums.layout, []
    start = layout.base
    for effect in fitted_effects(study, named):
        if isinstance(effect, MapEffect):
            size = float(effect.coefficients.square().mean().sqrt())
            found.append(_value(effect.name, "effect", "a value for each pixel, RMS", "m", [size]))
            continue
        terms = effect.terms(effect.shape)
        drawn = (thetas[:, start : start + len(terms)] * effect.prior_sd()).T.tolist()
        parts = [(term.name, term.unit, one) for term, one in zip(terms, drawn, strict=True)]
        found += _values(effect.name, "effect", parts)
        start += len(terms)
    return found


def _values(
    cause: str, kind: str, parts: Sequence[tuple[str, str, list[float]]]
) -> list[FittedValue]:
    return [_value(cause, kind, *part) for part in parts]


def _value(cause: str, kind: str, name: str, unit: str, drawn: list[float]) -> FittedValue:
    """Return a value from the estimate and what the resamples give."""
    estimate, *rest = drawn
    known = all(map(math.isfinite, drawn)) and bool(rest)
    return FittedValue(
        cause=cause,
        kind=kind,
        name=name,
        unit=unit,
        value=estimate,
        interval=interval_of(rest, estimate) if known else None,
    )
