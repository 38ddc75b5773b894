"""Levenberg-Marquardt on the normal equations of any objective, for comparison with L-BFGS."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from tofcorr.estimation.linear import NormalEquations
from tofcorr.estimation.objective import Objective, residual_variance
from tofcorr.estimation.parameters import Parameters
from tofcorr.estimation.solution import (
    Iteration,
    Solution,
    SolverOptions,
    Stopped,
    Watcher,
    nothing_to_estimate,
)

# Damping relative to the curvature of each unknown (Marquardt's), at the start, at least and at
# most. Beyond the largest, a step is too short to change the loss. Set by hand.
_FIRST_DAMPING = 1e-6
_LEAST_DAMPING = 1e-15
_LARGEST_DAMPING = 1e12


def minimise(
    objective: Objective,
    start: Parameters,
    options: SolverOptions | None = None,
    watcher: Watcher | None = None,
) -> Solution:
    """Minimise the loss by damped Gauss-Newton steps (damping scaled by the curvature, Marquardt).

    Args and result are those of `tofcorr.estimation.lbfgs.minimise`.
    """
    if not start.size:
        return nothing_to_estimate(start, float(objective.loss(start)))
    options = options or SolverOptions()
    here, equations = start, objective.normal_equations(start)
    damping, evaluations, history = _FIRST_DAMPING, 1, [float(equations.loss)]
    stopped: Stopped = "iteration_limit" if _finite(equations) else "not_finite"
    step_left, iterations = math.inf, 0
    while stopped == "iteration_limit":
        step_left = _step_left(equations, objective.num_residuals)
        if watcher and watcher(Iteration(iterations, history[-1], step_left, here)) is False:
            stopped = "interrupted"
        elif step_left <= options.tolerance:
            stopped = "converged"
        elif iterations >= options.max_iterations:
            break
        else:
            found = None
            while found is None and damping < _LARGEST_DAMPING:
                step = _step(equations, damping)
                trial = here.moved(step)
                new = objective.normal_equations(trial)
                evaluations += 1
                descends = bool(objective.change(here, step) <= 0)
                found = (trial, new) if descends and _finite(new) else None
                damping = max(damping / 10, _LEAST_DAMPING) if found else damping * 10
            if found is None:
                stopped = "line_search_failed"
            else:
                here, equations = found
                iterations += 1
                history.append(float(equations.loss))
    return Solution(
        parameters=here.detached(),
        loss=history[-1],
        stopped=stopped,
        iterations=iterations,
        evaluations=evaluations,
        message=f"{stopped.replace('_', ' ')}: the step left is {step_left:.1e} standard errors.",
        history=history,
    )


def _finite(equations: NormalEquations) -> bool:
    return bool(torch.isfinite(equations.loss) & equations.hessian.isfinite().all())


def _step(equations: NormalEquations, damping: float) -> Float[Tensor, "P"]:
    scale = equations.hessian.diagonal().clamp(min=1e-300).sqrt()
    hessian = equations.hessian / scale[:, None] / scale[None, :]
    damped = hessian + damping * torch.eye(len(scale), dtype=hessian.dtype)
    return -torch.linalg.solve(damped, equations.gradient / scale) / scale


def _step_left(equations: NormalEquations, num_residuals: float) -> float:
    """Return the length of the Gauss-Newton step in standard errors."""
    variance = residual_variance(float(equations.loss), equations.hessian, num_residuals)
    step = _step(equations, _LEAST_DAMPING)
    return math.sqrt(max(float(-(step @ equations.gradient)), 0.0) / variance)
