r"""Penalties on the roughness of curves, their strength chosen by cross-validation.

.. math:: \sum_v w_v r_v^2 + W \sum_p \lambda_p \lVert F_p \beta \rVert^2

with W the sum of the weights, so that a strength :math:`\lambda` means the same for any number of
pixels: it weighs the mean squared roughness against the mean squared residual. A penalty is a
Gaussian prior on the roughness, and is handed to the solvers as one.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from tofcorr.error_terms.base import Strength
from tofcorr.error_terms.model import ErrorModel
from tofcorr.estimation import levenberg_marquardt
from tofcorr.estimation.linear import NormalEquations
from tofcorr.estimation.moments import ImageMoments
from tofcorr.estimation.objective import MomentObjective
from tofcorr.estimation.parameters import Parameters
from tofcorr.estimation.prior import Prior, WithPrior
from tofcorr.estimation.solution import SolverOptions

STRENGTHS = tuple(10.0**exponent for exponent in range(-10, 1))
"""The strengths that cross-validation tries, without unit. Set by hand."""

# The strength at which cross-validation linearises and starts its search: the middle of STRENGTHS.
_MODERATE = 1e-5
# Share of each curvature added, so that directions that neither images nor penalty determine stay
# near zero. Set by hand, well above rounding.
_RIDGE = 1e-10
# Passes over the penalties when several strengths are searched for. Set by hand.
_SWEEPS = 2


@dataclass(frozen=True)
class Penalty:
    """The roughness of one term.

    Attributes:
        name: The term's first symbol, for messages.
        factor: Rows F, shape (R, K), of all coefficients of the model.
        strength: Its weight, or "auto".
    """

    name: str
    factor: Float[Tensor, "R K"]
    strength: Strength


def penalties_of(model: ErrorModel) -> list[Penalty]:
    """Return the penalties of a model's terms."""
    size = len(model.symbols())
    found = []
    for term, start in model.penalised():
        rows = term.roughness()
        factor = torch.zeros(len(rows), size, dtype=torch.float64)
        factor[:, start : start + rows.shape[1]] = rows
        found.append(Penalty(term.symbols[0], factor, term.strength))
    return found


def smoothness(
    penalties: Sequence[Penalty], total_weight: float, centre: Parameters
) -> Prior | None:
    """Return penalties of known strength as a prior; None if there are none.

    Args:
        penalties: Their strengths must be numbers.
        total_weight: Sum of the weights of the pixels fitted.
        centre: Any parameters; only their number of unknowns matters.
    """
    rows = [
        float(penalty.strength) ** 0.5 * penalty.factor
        for penalty in penalties
        if float(penalty.strength) > 0
    ]
    if not rows:
        return None
    factor = torch.cat(rows)
    hand_eye = torch.zeros(len(factor), centre.twist_size, dtype=torch.float64)
    return Prior(
        centre=replace(centre.detached(), coefficients=torch.zeros_like(centre.coefficients)),
        factor=torch.cat([hand_eye, factor], dim=1),
        variance=total_weight,
        names=[f"smoothness of {penalty.name}" for penalty in penalties],
    )


def total_weight(moments: ImageMoments) -> float:
    """Return the sum of the weights of all pixels."""
    return float(moments.gram[:, -1, -1].sum())


def with_strengths(
    penalties: Sequence[Penalty],
    moments: ImageMoments,
    start: Parameters,
    folds: Sequence[Sequence[int]],
) -> list[Penalty]:
    """Choose the strengths that are "auto" by cross-validation, one penalty after the other.

    The problem is linear but for the rotation, so one linearisation serves all folds and
    strengths: a fold's fit is one solution of the summed normal equations of its images.

    Args:
        penalties: Those of the model.
        moments: Of the images to fit.
        start: Where to start the fit around which the problem is linearised.
        folds: The images held out, positions in `moments`, fold by fold.
    """
    chosen = [_at(p, _MODERATE) if p.strength == "auto" else p for p in penalties]
    unknown = [k for k, penalty in enumerate(penalties) if penalty.strength == "auto"]
    if not unknown:
        return chosen
    around = _fitted(moments, start, chosen)
    equations = MomentObjective(moments).image_equations(around)
    for _ in range(_SWEEPS if len(unknown) > 1 else 1):
        for k in unknown:
            tried = [
                [*chosen[:k], _at(chosen[k], strength), *chosen[k + 1 :]] for strength in STRENGTHS
            ]
            losses = [_held_out(equations, moments, around, trial, folds) for trial in tried]
            chosen = tried[min(range(len(losses)), key=losses.__getitem__)]
    return chosen


def _at(penalty: Penalty, strength: float) -> Penalty:
    return replace(penalty, strength=strength)


def _fitted(moments: ImageMoments, start: Parameters, penalties: Sequence[Penalty]) -> Parameters:
    prior = smoothness(penalties, total_weight(moments), start)
    objective = MomentObjective(moments)
    options = SolverOptions(max_iterations=20, tolerance=1e-3)
    objective = objective if prior is None else WithPrior(objective, prior)
    return levenberg_marquardt.minimise(objective, start, options).parameters


def _held_out(
    equations: NormalEquations,
    moments: ImageMoments,
    around: Parameters,
    penalties: Sequence[Penalty],
    folds: Sequence[Sequence[int]],
) -> float:
    """Return the loss of the held-out images, summed over the folds."""
    total = 0.0
    weights = moments.gram[:, -1, -1]
    for fold in folds:
        test = torch.zeros(moments.num_images, dtype=torch.bool)
        test[torch.as_tensor(fold, dtype=torch.long)] = True
        hessian, gradient = equations.hessian[~test].sum(0), equations.gradient[~test].sum(0)
        prior = smoothness(penalties, float(weights[~test].sum()), around)
        if prior is not None:
            added = prior.equations(around)
            hessian, gradient = hessian + added.hessian, gradient + added.gradient
        step = gauss_newton_step(hessian, gradient)
        loss = equations.loss[test].sum() + 2 * (equations.gradient[test].sum(0) @ step)
        total += float(loss + step @ equations.hessian[test].sum(0) @ step)
    return total


def gauss_newton_step(
    hessian: Float[Tensor, "P P"], gradient: Float[Tensor, "P"]
) -> Float[Tensor, "P"]:
    """Return the step to the minimum of a quadratic, shape (P,), damped where it is flat."""
    scale = hessian.diagonal().clamp(min=1e-300).sqrt()
    unit = hessian / scale[:, None] / scale[None, :]
    damped = unit + _RIDGE * torch.eye(len(scale), dtype=hessian.dtype)
    return -torch.linalg.solve(damped, gradient / scale) / scale
