"""The model linearised where it ends, and the forms of effects that are chosen by that.

Columns of a study are derivatives at the base fit. An effect that the base fit took for its own
moves the hand-eye transform by centimetres, and with it all that the effects depend on.
"""

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from tofcorr.diagnosis.sums.base import filtered_inputs
from tofcorr.diagnosis.sums.linear_system import BASE, pose_sums
from tofcorr.diagnosis.sums.observations import effect_inputs
from tofcorr.diagnosis.sums.study import Study, with_residual
from tofcorr.geometry import se3
from tofcorr.simulation.effects import CatalogueEffect

# Steps of a fit of base model and effects that are not linear. Set on rendered walls: after that
# the strength of second bounces changes by 1 % at most.
_SETTLED = 4
# Pixels that are enough to find where that ends: a hundred or so of each pose. Chosen.
_FEW_PIXELS = 5_000
# A step that promises to lower the squares by less than this share changes nothing. Chosen.
_NOTHING = 1e-3
# By how much the camera is moved to see what depends on its pose, metres and radians: so far that
# the patches of surfaces, which meet one plane or another, change evenly. Chosen.
_MOVED = 0.003


def in_best_forms(study: Study) -> Study:
    """Return the study with each effect in the form that best predicts poses left out."""
    for name, effect in study.effects.items():
        study = _in_best_form(study, name, effect.forms(study.inputs)[1:])
    return study


def _in_best_form(study: Study, name: str, others: Sequence[CatalogueEffect]) -> Study:
    """Return the study with an effect in the form that best predicts poses left out.

    Each of the other forms is fitted together with the base model, until its constants and the
    geometry that it depends on change no more: alone, the base fit takes a part for its own.

    Args:
        study: With the effect in its usual form.
        name: The effect.
        others: Its other forms.
    """
    if not others:
        return study
    few = _of_few(study)
    bare = replace(few, columns={BASE: few.columns[BASE]}, effects={})

    def in_form(study: Study, form: CatalogueEffect) -> Study:
        columns = {**study.columns, name: form.scaled_columns(study.inputs)}
        return _summed(replace(study, effects={**study.effects, name: form}, columns=columns))

    def solved(study: Study) -> Tensor:
        return study.sums.ols.solve((name,))

    def left_out(study: Study) -> float:
        gls = study.sums.with_pose_uncertainty((name,)).gls
        return float(gls.squares_at((name,), gls.left_out_coefficients((name,))).sum())

    least, best = left_out(in_form(bare, study.effects[name])), study
    for form in others:
        tried = in_form(bare, form)
        for _ in range(_SETTLED):
            tried = _linearised_at(tried, solved(tried), tried, (name,), again=True)
        if (left := left_out(tried)) < least:
            least, best = left, in_form(study, tried.effects[name])
            best = _linearised_at(best, solved(tried), best, (name,))
    return replace(best, sums=best.sums.with_pose_uncertainty())


def _of_few(study: Study) -> Study:
    """Return the study of few pixels; its sums are still those of all."""
    few = slice(None, None, max(1, len(study.residual) // _FEW_PIXELS))
    fit, some = study.fit, study.observations.at(few)
    fit = replace(
        fit,
        model=fit.model.on(some),
        residual=fit.residual[few],
        sigma=fit.sigma[few],
        trust=fit.trust[few],
        known=fit.known and fit.known.at(few),
    )
    return replace(
        study,
        observations=some,
        fit=fit,
        inputs=filtered_inputs(effect_inputs(some, fit.tool_from_camera), some, fit),
        columns={name: columns[few] for name, columns in study.columns.items()},
        pose=study.pose[few],
        residual=study.residual[few],
        straight=study.straight[few],
    )


def _summed(study: Study) -> Study:
    """Return the study with the sums of its columns."""
    base = torch.arange(study.sums.layout.base)
    prior = study.sums.layout.prior_of(base)
    fit = replace(study.fit, residual=study.residual)
    sums = pose_sums(study.observations, study.columns, study.pose, fit, prior)
    return replace(study, sums=sums)


def relinearised(study: Study, names: Sequence[str]) -> Study:
    """Return the study linearised at the coefficients of a model.

    Columns are derivatives at the base fit and at no effect. Mixed or saturated signals are not
    linear in their strength, and an effect that the base fit took for its own moves the geometry
    that both depend on. With J the derivative at the fitted coefficients c, the residual
    r = y - (f(c) - J c) and the columns J replace those of the base model and of the effects
    `names`, where one of these is not linear. Steps are those of Gauss and Newton; one after which
    the model leaves more than before is halved.

    Args:
        study: The recording.
        names: Effects of the model.
    """
    names = [name for name in names if name in study.effects]
    if all(study.effects[name].linear for name in names):
        return study
    # What other surfaces send takes long to compute: a few pixels say where that is.
    costly = any(study.effects[name].depends_on_pose for name in names)
    start = _summed(_of_few(study)) if costly else study
    prior = start.sums.layout.only(names).prior

    def loss(left: Tensor, theta: Tensor) -> float:
        """Return the squares of what is left and of the coefficients, each over its variance."""
        squares = start.sums.scale * (start.fit.share * left**2).sum()
        return float(squares + theta @ prior @ theta)

    best, theta = start, torch.zeros(len(prior)).double()
    least = loss(start.straight, theta)  # Of the base fit.
    for _ in range(_SETTLED):
        goal = best.sums.ols.solve(names)
        if loss(best.residual - best.times(names, goal), goal) > (1 - _NOTHING) * least:
            break
        for part in (1.0, 0.5, 0.25):
            there = torch.lerp(theta, goal, part)
            tried = _linearised_at(start, there, best, names)
            # With its derivatives taken off, what the model itself leaves there.
            if (now := loss(tried.residual - tried.times(names, there), there)) < least:
                best, least, theta = tried, now, there
                break
        else:
            break
    return _linearised_at(study, theta, study, names) if costly else best


def _linearised_at(
    study: Study, theta: Tensor, before: Study, names: Sequence[str], *, again: bool = False
) -> Study:
    """Return the study with the model linearised at some coefficients.

    Args:
        study: The recording.
        theta: The coefficients (K,).
        before: What they are of, linearised elsewhere.
        names: Effects of the model.
        again: Whether the effects' constants are found again.
    """
    fit, model = study.fit, study.fit.model.moved(theta)
    step, count = theta[: model.num_columns], model.num_geometry
    coefficients, pose = fit.coefficients + step[count:], fit.tool_from_camera
    if model.hand_eye_free:
        pose = pose @ se3.exp(step[:6])
    observations = model.observations
    distance, columns = model.linearised(pose)
    predicted = distance + columns[:, count:] @ coefficients
    inputs = filtered_inputs(effect_inputs(observations, pose), observations, fit)

    def error(frame: Tensor, pixel: Tensor) -> Tensor:
        some, ends = observations.choosing(frame, pixel), observations.measured.aminmax()
        found = model.on(some).error_columns(some.measured.clamp(*ends)) @ coefficients
        on_target = observations.on_target.flatten(1)[frame, pixel]
        return torch.where(on_target, torch.nan, found)

    places, effects = before.sums.layout.only(names).effects, dict(study.effects)
    changed, added = dict[str, Tensor](), torch.zeros_like(predicted)
    for name in (name for name in names if not effects[name].linear):
        sd = effects[name].prior_sd()
        own = theta[slice(*places[name])] * sd
        effect = effects[name].with_coefficients(own)
        effects[name] = effect = effect.again(inputs, error) if again else effect
        slope, here = effect.slope(inputs, own), effect.shift(inputs, own)
        changed[name], predicted = slope * sd, predicted + here
        added = added + slope @ own
        if model.hand_eye_free and effect.depends_on_pose:
            for k, moved in enumerate(_MOVED * torch.eye(6).double()):
                there = effect_inputs(observations, pose @ se3.exp(moved))
                there = filtered_inputs(there, observations, fit)
                columns[:, k] += (effect.shift(there, own) - here) / _MOVED
    # What was known, or taken off before, stays as it is.
    known = 0.0 if fit.known is None else fit.known.error
    left = observations.measured - predicted
    residual = study.straight - fit.residual + left - known + columns @ step + added
    further = study.columns[BASE][:, model.num_columns :]
    changed[BASE] = torch.cat([columns, further], dim=1)
    return replace(with_residual(before, residual, names, changed), effects=effects)
