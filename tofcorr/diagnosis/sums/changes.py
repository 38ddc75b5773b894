"""Steps that change the model of a study: each returns another study."""

from collections.abc import Collection, Sequence
from dataclasses import replace

from torch import Tensor

from tofcorr.diagnosis.sums.blocks import solve, with_pose_uncertainty
from tofcorr.diagnosis.sums.linear_system import LinearSystem, changed_system
from tofcorr.diagnosis.sums.study import Study, residual_of

# Most linearisations of effects that are not linear; the second or third changes nothing any more.
_MOST_LINEARISATIONS = 3


def with_poses_reestimated(study: Study, names: Sequence[str]) -> Study:
    """Return the study whose pose uncertainty is estimated with these effects in the model."""
    known = [name for name in names if name in study.system.blocks.layout.effects]
    blocks = with_pose_uncertainty(study.system.moments, known, study.system.blocks)
    return replace(study, system=replace(study.system, blocks=blocks))


def with_residual(study: Study, residual: Tensor) -> Study:
    """Return the study of another residual (M,), metres."""
    system = changed_system(study.system, study.observations, study.fit, residual)
    return replace(study, system=system)


def without_map(study: Study, values: Tensor, spent: Collection[str]) -> Study:
    """Return the study with a map subtracted.

    Args:
        study: Before.
        values: The map's value in each pixel, shape (M,), metres.
        spent: Maps that are candidates no longer.
    """
    maps = {name: m for name, m in study.candidates.maps.items() if name not in spent}
    changed = with_residual(study, study.system.residual - values)
    return replace(changed, candidates=replace(study.candidates, maps=maps))


def relinearised(study: Study, names: Sequence[str]) -> Study:
    """Return the study with effects of the model linearised at their fitted coefficients.

    Columns are derivatives at zero. Mixed or saturated signals are not linear in their strength.
    With J the derivative at the fitted coefficients c, the residual r = y - (shift(c) - J c) and
    the columns J replace those at zero, for the effects `names` only. A linearisation is kept if
    it lowers the sum of squares.
    """
    best, best_loss = study, _loss(study, names)
    effects = study.candidates.effects
    bent = [name for name in names if name in effects and not effects[name].linear]
    if not bent:
        return study
    current = study
    for _ in range(_MOST_LINEARISATIONS):
        system = _linearised_again(current.system, study, names, bent)
        current = replace(current, system=system)
        loss = _loss(current, names)
        if not loss < best_loss:
            break
        best, best_loss = current, loss
    return best


def _linearised_again(
    current: LinearSystem, plain: Study, names: Sequence[str], bent: Sequence[str]
) -> LinearSystem:
    """Linearise the effects `bent` at the coefficients that the current system gives."""
    layout = current.blocks.layout
    theta, places = solve(current.blocks.even, names), layout.only(names).effects
    residual = plain.system.residual
    changed: dict[str, Tensor] = {}
    for name in bent:
        effect = plain.candidates.effects[name]
        own = theta[slice(*places[name])] * effect.prior_sd()
        slope = effect.slope(plain.inputs, own)
        residual = residual - (effect.shift(plain.inputs, own) - slope @ own)
        changed[name] = slope * effect.prior_sd()
    return changed_system(current, plain.observations, plain.fit, residual, names, changed)


def _loss(study: Study, names: Sequence[str]) -> float:
    """Return the weighted sum of squares of a model fitted to all poses, m^2."""
    return float((study.fit.share * residual_of(study, names) ** 2).sum())
