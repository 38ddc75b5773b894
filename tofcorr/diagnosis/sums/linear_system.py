"""The linear system of a model: its columns, its residual, and their sums over each pose."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from tofcorr.diagnosis.sums.base_fit import BaseFit
from tofcorr.diagnosis.sums.blocks import EVEN_SD, Blocks, solve, with_pose_uncertainty
from tofcorr.diagnosis.sums.candidate_effects import CandidateEffects
from tofcorr.diagnosis.sums.columns import Columns
from tofcorr.diagnosis.sums.layout import Layout
from tofcorr.diagnosis.sums.moments import (
    Moments,
    gather_moments,
    pose_columns,
    with_changed,
)
from tofcorr.diagnosis.sums.observations import Observations
from tofcorr.diagnosis.sums.probes import Probe
from tofcorr.diagnosis.sums.unknown_amplitude import unknown_amplitude_columns
from tofcorr.pixels.in_threads import in_threads
from tofcorr.pixels.thread_number import threads_at_once
from tofcorr.simulation.effects import CatalogueEffect
from tofcorr.simulation.effects.inputs import EffectInputs


@dataclass(frozen=True, kw_only=True)
class LinearSystem:
    """Columns of all candidates, the residual they may explain, and their sums.

    Attributes:
        columns: Of base model, effects and probes.
        pose: Columns of an uncertain pose, shape (M, 3).
        residual: Of the base fit less the maps already subtracted, shape (M,), metres.
        moments: Sums of products of these over the pixels of every pose.
        blocks: The same with the uncertainty of the poses included.
    """

    columns: Columns
    pose: Tensor
    residual: Tensor
    moments: Moments
    blocks: Blocks


def linear_system(
    observations: Observations, fit: BaseFit, inputs: EffectInputs, candidates: CandidateEffects
) -> LinearSystem:
    """Compute all columns and sum them up."""
    columns, layout = _columns(
        observations, fit, inputs, {**candidates.effects, **candidates.probes}
    )
    pose = pose_columns(inputs)
    moments = gather_moments(observations, columns, pose, fit.residual, fit, layout)
    return LinearSystem(
        columns=columns,
        pose=pose,
        residual=fit.residual,
        moments=moments,
        blocks=with_pose_uncertainty(moments),
    )


def changed_system(
    system: LinearSystem,
    observations: Observations,
    fit: BaseFit,
    residual: Tensor,
    names: Sequence[str] = (),
    changed: Mapping[str, Tensor] | None = None,
) -> LinearSystem:
    """Return the system of another residual, and of other columns.

    Args:
        system: The system before.
        observations: The pixels.
        fit: Its noise and robust weights.
        residual: The new one, shape (M,), metres.
        names: Effects of the model whose residual the uncertainty of the poses is estimated from.
        changed: The columns of effects that differ, shape (M, E) each; None: all are the same.
    """
    changed = changed or {}
    columns = system.columns.with_changed(changed)
    moments = with_changed(
        system.moments, observations, columns, system.pose, residual, fit, changed
    )
    return replace(
        system,
        columns=columns,
        residual=residual,
        moments=moments,
        blocks=with_pose_uncertainty(moments, names),
    )


def residual_of(system: LinearSystem, names: Sequence[str]) -> Tensor:
    """Return the residual of base model and effects fitted to all poses, shape (M,), metres."""
    return system.residual - system.columns.times(names, solve(system.blocks.even, names))


def _columns(
    observations: Observations,
    fit: BaseFit,
    inputs: EffectInputs,
    sources: Mapping[str, CatalogueEffect | Probe],
) -> tuple[Columns, Layout]:
    """Return the columns of base model, effects and probes, and their layout."""
    uncertain = unknown_amplitude_columns(observations, inputs)
    if fit.known is not None:
        uncertain = torch.cat([fit.known.uncertain, uncertain], dim=1)
    num_units = observations.num_units
    # A strength weighs roughness against the mean square, so that it is multiplied by the sum of
    # the even weights: one a pose, each with a variance of EVEN_SD^2.
    prior = fit.model.prior_precision() + num_units / EVEN_SD**2 * fit.model.roughness()

    def own_columns(source: CatalogueEffect | Probe) -> Tensor:
        own = source.columns(inputs)
        return own * source.prior_sd() if isinstance(source, CatalogueEffect) else own

    found = in_threads(own_columns, sources.values(), threads_at_once())
    effects = dict(zip(sources, found, strict=True))
    base = torch.cat([fit.model.columns(fit.tool_from_camera), uncertain], dim=1)
    columns = Columns(base=base, effects=effects)
    ones = torch.eye(uncertain.shape[1], dtype=torch.float64)
    return columns, columns.layout(torch.block_diag(prior, ones))
