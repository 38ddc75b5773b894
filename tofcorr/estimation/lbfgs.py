"""Preconditioned L-BFGS with strong Wolfe line search (torch's), on any objective.

The steps are taken in whitened coordinates: one Gauss-Newton Hessian at the start makes every
direction one standard error long. On raw parameters L-BFGS stops while the hand-eye is still
millimetres off, at an almost perfect residual; whitened, it needs a dozen iterations.
"""

import math
from collections.abc import Callable
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor

from tofcorr.estimation.curvature import curved, least_curvature
from tofcorr.estimation.linear import NormalEquations
from tofcorr.estimation.objective import Objective, residual_variance
from tofcorr.estimation.optimisers import uncompiled
from tofcorr.estimation.parameters import Parameters
from tofcorr.estimation.solution import (
    Iteration,
    Solution,
    SolverOptions,
    Stopped,
    Watcher,
    nothing_to_estimate,
)

# Steps that L-BFGS remembers: more than a whitened fit takes. Set by hand.
_MEMORY = 20
# Most evaluations of a line search; torch's own default for a whole step.
_EVALUATIONS_PER_LINE_SEARCH = 25
# Curvature below this share of the largest (after scaling each parameter to its own curvature) is
# not resolved in float64: such a direction is scaled as if its curvature were that share. Set by
# hand.
_RESOLVED_CURVATURE = 1e-12
# How often a stalled line search is restarted with a new Hessian before it counts as failed. Set
# by hand.
_RESTARTS = 3


def minimise(
    objective: Objective,
    start: Parameters,
    options: SolverOptions | None = None,
    watcher: Watcher | None = None,
) -> Solution:
    """Minimise the loss from `start` until the step left is a negligible share of a standard error.

    Args:
        objective: The loss.
        start: Where to begin.
        options: Iteration limit and tolerance.
        watcher: Called after each iteration; returning False interrupts.

    Returns:
        The best parameters and the reason for stopping. If the loss stops being finite, or the
        line search fails, they are the last good ones, and `stopped` says so.
    """
    if not start.size:
        return nothing_to_estimate(start, float(objective.loss(start)))
    run = _Run(objective, start, options or SolverOptions(), watcher)
    stopped = run.descend()
    for _ in range(_RESTARTS):
        if stopped == "line_search_failed":
            stopped = run.descend()
    return run.solution(stopped)


class _Run:
    """One minimisation: its best point so far, and how many iterations and evaluations it took."""

    def __init__(
        self,
        objective: Objective,
        start: Parameters,
        options: SolverOptions,
        watcher: Watcher | None,
    ) -> None:
        self.objective = objective
        self.options = options
        self.watcher = watcher
        self._best: Callable[[], Parameters] = lambda: start
        self.best_loss = math.inf
        self.step_left = math.inf
        self.iterations = 0
        self.evaluations = 0
        self.history: list[float] = []

    @property
    def best(self) -> Parameters:
        """The best point so far, computed when asked for."""
        return self._best()

    def descend(self) -> Stopped:
        """Run L-BFGS from the best point, whitened there; return why it stopped."""
        origin = self.best
        equations = self.objective.normal_equations(origin)
        if not bool(torch.isfinite(equations.loss) & equations.hessian.isfinite().all()):
            return "not_finite"
        self.best_loss = float(equations.loss)
        self.history = self.history or [self.best_loss]
        variance = self._variance(equations.hessian)
        evaluate = _Memory(self, origin, equations, variance)
        z = torch.zeros(origin.size, dtype=torch.float64, requires_grad=True)
        optimiser = uncompiled(torch.optim.LBFGS)(
            [z],
            max_iter=1,
            max_eval=_EVALUATIONS_PER_LINE_SEARCH,
            tolerance_grad=0.0,
            tolerance_change=0.0,
            history_size=_MEMORY,
            line_search_fn="strong_wolfe",
        )
        self.step_left = self._in_standard_errors(evaluate(z)[1], evaluate)
        stopped = None if self.iterations or self._goes_on() else "interrupted"
        while stopped is None:
            stopped = self._limit() or self._iterate(optimiser, evaluate, z)
        return stopped

    def _limit(self) -> Stopped | None:
        if self.step_left <= self.options.tolerance:
            return "converged"
        return "iteration_limit" if self.iterations >= self.options.max_iterations else None

    def _iterate(
        self, optimiser: torch.optim.LBFGS, evaluate: "_Memory", z: Float[Tensor, "P"]
    ) -> Stopped | None:
        """Take one step; return why to stop, or None to go on."""
        before, change_before = z.detach().clone(), evaluate(z)[0]
        optimiser.step(lambda: _closure(evaluate, z))  # type: ignore[arg-type]
        change, gradient = evaluate(z)
        if not (math.isfinite(change) and bool(z.isfinite().all())):
            return "not_finite"
        if change > change_before or torch.equal(before, z.detach()):
            return "line_search_failed"
        self.iterations += 1
        self.best_loss = evaluate.total(change)
        self._best = partial(evaluate.at, z.detach().clone())
        self.history.append(self.best_loss)
        self.step_left = self._in_standard_errors(gradient, evaluate)
        return None if self._goes_on() else "interrupted"

    def _variance(self, hessian: Float[Tensor, "P P"]) -> float:
        return residual_variance(self.best_loss, hessian, self.objective.num_residuals)

    def _in_standard_errors(self, gradient: Float[Tensor, "P"], evaluate: "_Memory") -> float:
        """Return the Newton step's length in standard errors.

        The whitened gradient is that step in the standard errors of the start. It is scaled to the
        residual variance of now.
        """
        now = self._variance(evaluate.hessian)
        return float(gradient.norm()) * math.sqrt(evaluate.variance / now)

    def _goes_on(self) -> bool:
        if self.watcher is None:
            return True
        iteration = Iteration(self.iterations, self.best_loss, self.step_left, self.best)
        return self.watcher(iteration) is not False

    def solution(self, stopped: Stopped) -> Solution:
        """Return the best point, and why the run stopped in one sentence."""
        left = f"the step left is {self.step_left:.1e} standard errors"
        message = {
            "converged": f"Converged: {left}.",
            "iteration_limit": f"Not converged: stopped at {self.iterations} iterations, {left}.",
            "line_search_failed": f"The line search failed; rolled back to the best point, {left}.",
            "not_finite": "The loss became NaN or infinite; rolled back to the last good point.",
            "interrupted": f"Interrupted after {self.iterations} iterations, {left}.",
        }[stopped]
        return Solution(
            parameters=self.best.detached(),
            loss=self.best_loss,
            stopped=stopped,
            iterations=self.iterations,
            evaluations=self.evaluations,
            message=message,
            history=self.history,
        )


class _Memory:
    """Evaluates the change of the loss since the start, and remembers the latest points.

    The change is divided by twice the residual variance. torch's L-BFGS evaluates the end of its
    last line search a second time; remembering that point saves the evaluation.
    """

    def __init__(
        self,
        run: _Run,
        origin: Parameters,
        equations: NormalEquations,
        variance: float,
    ) -> None:
        self._run, self._origin = run, origin
        self._whitening = whitening(equations.hessian / variance)
        self.hessian = equations.hessian
        self.variance = variance
        self._origin_loss = float(equations.loss)
        at_origin = self._whitening.T @ equations.gradient / variance
        self._seen = [(torch.zeros_like(at_origin), 0.0, at_origin)]

    def at(self, z: Float[Tensor, "P"]) -> Parameters:
        """Return the parameters of a whitened point."""
        return self._origin.moved(self._whitening @ z)

    def total(self, change: float) -> float:
        """Return the loss for a change that `__call__` returned."""
        return self._origin_loss + change * 2 * self.variance

    def __call__(self, z: Float[Tensor, "P"]) -> tuple[float, Float[Tensor, "P"]]:
        for known, loss, gradient in reversed(self._seen):
            if torch.equal(known, z):
                return loss, gradient
        point = z.detach().clone().requires_grad_(True)
        change = self._run.objective.change(self._origin, self._whitening @ point)
        change = change / (2 * self.variance)
        (gradient,) = torch.autograd.grad(change, point)
        self._run.evaluations += 1
        seen = (point.detach(), float(change.detach()), gradient)
        self._seen = [*self._seen[-_EVALUATIONS_PER_LINE_SEARCH:], seen]
        return seen[1], gradient


def _closure(evaluate: _Memory, z: Float[Tensor, "P"]) -> Float[Tensor, ""]:
    loss, gradient = evaluate(z)
    z.grad = gradient.clone()
    return torch.tensor(loss, dtype=torch.float64)


def whitening(hessian: Float[Tensor, "P P"]) -> Float[Tensor, "P P"]:
    """Return W, shape (P, P), with W^T H W = 1 on every direction that float64 resolves.

    The rows of unknowns without any curvature are zero.
    """
    scale = hessian.diagonal().clamp(min=least_curvature(hessian)).sqrt()
    values, vectors = torch.linalg.eigh(hessian / scale[:, None] / scale[None, :])
    values = values.clamp(min=_RESOLVED_CURVATURE * float(values.max()))
    whitened = (vectors / values.sqrt()) / scale[:, None]
    # The row of an unknown without curvature is rounding over almost zero: it does not move.
    return torch.where(curved(hessian)[:, None], whitened, 0.0)
