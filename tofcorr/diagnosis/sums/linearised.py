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

# How often an effect in another form than the usual one is fitted together with the base model. Set
# on rendered walls: after that the strength of second bounces changes by 1 % at most.
_SETTLED = 4
# Pixels that are enough for that: a hundred or so of each pose. Chosen.
_FEW_PIXELS = 5_000


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
    layout = study.sums.layout
    prior = layout.prior_of(torch.arange(layout.base))
    few = slice(None, None, max(1, len(study.residual) // _FEW_PIXELS))
    fit, some = study.fit, study.observations.at(few)
    base = {BASE: study.columns[BASE][few]}
    residual = study.residual[few]
    fit_of_few = replace(
        fit,
        model=fit.model.on(some),
        residual=residual,
        sigma=fit.sigma[few],
        trust=fit.trust[few],
        known=fit.known and fit.known.at(few),
    )
    inputs = filtered_inputs(effect_inputs(some, fit.tool_from_camera), some, fit_of_few)
    sparse = replace(
        study,
        observations=some,
        fit=fit_of_few,
        inputs=inputs,
        pose=study.pose[few],
        residual=residual,
        straight=residual,
    )

    def in_form(form: CatalogueEffect) -> Study:
        columns = {**base, name: form.scaled_columns(inputs)}
        sums = pose_sums(some, columns, sparse.pose, fit_of_few, prior)
        return replace(sparse, effects={name: form}, columns=columns, sums=sums)

    def left_out(study: Study) -> float:
        gls = study.sums.with_pose_uncertainty((name,)).gls
        return float(gls.squares_at((name,), gls.left_out_coefficients((name,))).sum())

    least, best = left_out(in_form(study.effects[name])), study
    for form in others:
        tried, theta = in_form(form), fit.coefficients
        for _ in range(_SETTLED):
            theta = tried.sums.ols.solve((name,))
            tried = _linearised_at(tried, theta, tried, (name,), again=True)
        if (left := left_out(tried)) < least:
            own, least = tried.effects[name], left
            columns = {**study.columns, name: own.scaled_columns(study.inputs)}
            best = replace(study, columns=columns, effects={**study.effects, name: own})
            sums = pose_sums(study.observations, columns, study.pose, study.fit, prior)
            best = _linearised_at(best, theta, replace(best, sums=sums), (name,))
    return replace(best, sums=best.sums.with_pose_uncertainty())


def relinearised(study: Study, names: Sequence[str]) -> Study:
    """Return the study linearised at the coefficients of a model.

    Columns are derivatives at the base fit and at no effect. Mixed or saturated signals are not
    linear in their strength, and an effect that the base fit took for its own moves the geometry
    that both depend on. With J the derivative at the fitted coefficients c, the residual
    r = y - (f(c) - J c) and the columns J replace those of the base model and of the effects
    `names`, where one of these is not linear. A linearisation is kept if it lowers the sum of
    squares.

    Args:
        study: The recording.
        names: Effects of the model.
    """
    names = [name for name in names if name in study.effects]
    bent = not all(study.effects[name].linear for name in names)

    def loss(study: Study) -> float:
        """Return the weighted sum of squares of the model fitted to all poses, m^2."""
        return float((study.fit.share * study.residual_of(names) ** 2).sum())

    best, least, current = study, loss(study), study
    for _ in range(3 if bent else 0):  # The second or third changes nothing any more.
        current = _linearised_at(study, current.sums.ols.solve(names), current, names)
        if not (now := loss(current)) < least:
            break
        best, least = current, now
    return best


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
    left = observations.measured - distance - columns[:, count:] @ coefficients
    # What was known, or taken off before, stays as it is.
    known = 0.0 if fit.known is None else fit.known.error
    residual = study.straight - fit.residual + left - known + columns @ step
    further = study.columns[BASE][:, model.num_columns :]
    changed = {BASE: torch.cat([columns, further], dim=1)}
    inputs = filtered_inputs(effect_inputs(observations, pose), observations, fit)

    def error(frame: Tensor, pixel: Tensor) -> Tensor:
        some, ends = observations.choosing(frame, pixel), observations.measured.aminmax()
        found = model.on(some).error_columns(some.measured.clamp(*ends)) @ coefficients
        on_target = observations.on_target.flatten(1)[frame, pixel]
        return torch.where(on_target, torch.nan, found)

    places, effects = before.sums.layout.only(names).effects, dict(study.effects)
    for name in (name for name in names if not effects[name].linear):
        sd = effects[name].prior_sd()
        own = theta[slice(*places[name])] * sd
        effect = effects[name].with_coefficients(own)
        effects[name] = effect = effect.again(inputs, error) if again else effect
        slope = effect.slope(inputs, own)
        residual = residual - (effect.shift(inputs, own) - slope @ own)
        changed[name] = slope * sd
    return replace(with_residual(before, residual, names, changed), effects=effects)
