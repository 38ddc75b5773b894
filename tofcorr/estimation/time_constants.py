"""The time constant of a warm-up, the only parameter in which a condition term is not linear."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from tofcorr.estimation.linear import NormalEquations
from tofcorr.estimation.moments import ImageMoments
from tofcorr.estimation.objective import MomentObjective
from tofcorr.estimation.parameters import Parameters
from tofcorr.estimation.regularisation import gauss_newton_step

# Time constants tried, evenly in the logarithm, before the best is refined. Set by hand.
_GRID = 16


def time_constant(moments: ImageMoments, around: Parameters, time: Float[Tensor, "N"]) -> float:
    """Return the time constant in seconds whose exponential reduces the loss most.

    For each time constant the amplitude of the exponential and all other parameters are optimal
    to first order; a grid in the logarithm is refined by Brent's method.

    Args:
        moments: Of the images, without the exponential.
        around: The best parameters without it.
        time: When the images were taken, shape (N,), seconds.
    """
    equations = MomentObjective(moments).image_equations(around)
    column = around.twist_size + moments.symbols.index("c0")
    duration = float(time.max() - time.min())
    if duration <= 0:
        return 1.0
    apart = duration / max(moments.num_images - 1, 1)
    low, high = math.log(apart), math.log(3 * duration)

    def gain(log_constant: float) -> float:
        decay = torch.exp(-(time - time.min()) / math.exp(log_constant))
        return _best_loss(_extended(equations, decay - decay.mean(), column))

    from scipy.optimize import minimize_scalar  # Takes a tenth of the time of torch to import.

    grid = torch.linspace(low, high, _GRID).tolist()
    best = min(range(_GRID), key=lambda k: gain(grid[k]))
    bounds = grid[max(best - 1, 0)], grid[min(best + 1, _GRID - 1)]
    return math.exp(minimize_scalar(gain, bounds=bounds, method="bounded").x)


def _extended(
    equations: NormalEquations, factor: Float[Tensor, "N"], column: int
) -> NormalEquations:
    """Return summed normal equations with one more unknown: a factor times that of `column`."""
    row = (factor[:, None] * equations.hessian[:, column]).sum(0)
    corner = (factor.square() * equations.hessian[:, column, column]).sum()
    hessian = torch.cat([equations.hessian.sum(0), row[None]])
    hessian = torch.cat([hessian, torch.cat([row, corner[None]])[:, None]], dim=1)
    slope = (factor * equations.gradient[:, column]).sum()
    gradient = torch.cat([equations.gradient.sum(0), slope[None]])
    return NormalEquations(equations.loss.sum(), gradient, hessian)


def _best_loss(equations: NormalEquations) -> float:
    step = gauss_newton_step(equations.hessian, equations.gradient)
    return float(equations.loss + equations.gradient @ step)
