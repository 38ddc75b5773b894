r"""What a fit finds beside its unknowns: strengths of penalties, time constants of a warm-up.

A penalty weighs the roughness of a curve:

.. math:: \sum_v w_v r_v^2 + W \sum_p \lambda_p \lVert F_p \beta \rVert^2

with W the sum of the weights, so that a strength :math:`\lambda` means the same for any number of
pixels: it weighs the mean squared roughness against the mean squared residual. A penalty is a
Gaussian prior on the roughness, and is handed to the solvers as one. Strengths that are left open
are chosen by cross-validation; of time constants, the one that reduces the loss most.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from tofcorr.error_terms.model import ErrorModel
from tofcorr.estimation.linear import RESOLVED, solved
from tofcorr.estimation.moments import ImageMoments, MomentObjective, Parameters, Prior
from tofcorr.estimation.solvers import SolverOptions, minimise

STRENGTHS = tuple(10.0**exponent for exponent in range(-10, 1))
"""The strengths that cross-validation tries, without unit. Set by hand."""


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
    strength: float | str


def penalties_of(model: ErrorModel) -> list[Penalty]:
    """Return the penalties of a model's terms."""
    size = len(model.symbols())
    found = []
    for term, start in model.penalised():
        rows = term.roughness()
        factor = torch.nn.functional.pad(rows.double(), (start, size - start - rows.shape[1]))
        found.append(Penalty(term.symbols[0], factor, term.options.strength))  # pyright: ignore
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
    rows = [float(one.strength) ** 0.5 * one.factor for one in penalties if float(one.strength)]
    if not rows:
        return None
    return Prior(
        centre=replace(centre.detached(), coefficients=torch.zeros_like(centre.coefficients)),
        factor=torch.nn.functional.pad(torch.cat(rows), (centre.twist_size, 0)),
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
    folds: Sequence[Bool[Tensor, "N"]],
) -> list[Penalty]:
    """Choose the strengths that are "auto" by cross-validation, one penalty after the other.

    The problem is linear but for the rotation, so one linearisation serves all folds and
    strengths: a fold's fit is one solution of the summed normal equations of its images.

    Args:
        penalties: Those of the model.
        moments: Of the images to fit.
        start: Where to start the fit around which the problem is linearised.
        folds: The images held out, masks, fold by fold.
    """
    unknown = [k for k, penalty in enumerate(penalties) if penalty.strength == "auto"]
    if not unknown:
        return list(penalties)
    # Linearised, and searched from, the middle of the strengths.
    middle = STRENGTHS[len(STRENGTHS) // 2]
    chosen = [replace(p, strength=middle) if p.strength == "auto" else p for p in penalties]
    images = MomentObjective(moments, smoothness(chosen, total_weight(moments), start))
    around = minimise(images, start, SolverOptions(max_iterations=20)).parameters
    equations = images.image_equations(around)
    weights = moments.gram[:, -1, -1]

    def held_out(tried: list[Penalty]) -> float:
        """Return the loss of the images of each fold under the fit to all others."""
        total = 0.0
        for test in folds:
            kept, without = (equations.of(which).total() for which in (~test, test))
            prior = smoothness(tried, float(weights[~test].sum()), around)
            kept = kept.plus(None if prior is None else prior.equations(around))
            total += float(without.at(-solved(kept.hessian, kept.gradient, RESOLVED)).loss)
        return total

    for k in unknown * (2 if len(unknown) > 1 else 1):
        own = [replace(chosen[k], strength=one) for one in STRENGTHS]
        chosen = min([[*chosen[:k], one, *chosen[k + 1 :]] for one in own], key=held_out)
    return chosen


def time_constant(moments: ImageMoments, around: Parameters, time: Float[Tensor, "N"]) -> float:
    """Return the time constant in seconds whose exponential reduces the loss most.

    For each time constant the amplitude of the exponential and all other parameters are optimal
    to first order; a grid in the logarithm is refined by Brent's method.

    Args:
        moments: Of the images, without the exponential.
        around: The best parameters without it.
        time: When the images were taken, shape (N,), seconds.
    """
    from scipy.optimize import minimize_scalar  # Takes a tenth of the time of torch to import.

    each = MomentObjective(moments).image_equations(around)
    column = around.twist_size + moments.symbols.index("c0")
    duration = float(time.max() - time.min())
    if duration <= 0:
        return 1.0
    equations = each.total()

    def loss(log_constant: float) -> float:
        """Return the least loss with one more column: that of c0 times an exponential."""
        decay = torch.exp(-(time - time.min()) / math.exp(log_constant))
        decay = decay - decay.mean()
        row = decay @ each.hessian[:, column]
        corner = decay.square() @ each.hessian[:, column, column]
        hessian = torch.nn.functional.pad(equations.hessian, (0, 1, 0, 1))
        hessian[-1] = hessian[:, -1] = torch.cat([row, corner[None]])
        gradient = torch.cat([equations.gradient, (decay @ each.gradient[:, column])[None]])
        return float(equations.loss - gradient @ solved(hessian, gradient, RESOLVED))

    low, high = duration / max(len(moments.gram) - 1, 1), 3 * duration
    grid = torch.linspace(math.log(low), math.log(high), 16).tolist()
    best = min(range(1, len(grid) - 1), key=lambda k: loss(grid[k]))
    bounds = grid[best - 1], grid[best + 1]
    return math.exp(minimize_scalar(loss, bounds=bounds, method="bounded").x)
