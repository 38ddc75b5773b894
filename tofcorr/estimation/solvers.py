"""Where a fit starts, and how it finds the least loss: L-BFGS or damped Gauss-Newton steps.

L-BFGS (SciPy's, Zhu, Byrd, Lu and Nocedal 1997) runs in whitened coordinates: one Gauss-Newton
Hessian at the start makes every direction one standard error long. On raw parameters it stops while
the hand-eye is still millimetres off, at an almost perfect residual; whitened, it needs a dozen
iterations. The Gauss-Newton steps are damped in proportion to the curvature of each unknown
(Levenberg and Marquardt).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float
from pydantic import PositiveFloat, PositiveInt
from torch import Tensor

from tofcorr.estimation.linear import ROUNDING, Curvature, NormalEquations, solved
from tofcorr.estimation.moments import (
    LEAST_RESIDUAL,
    ImageMoments,
    MomentObjective,
    Objective,
    Parameters,
)
from tofcorr.geometry import se3
from tofcorr.options import Options

Stopped = Literal["converged", "iteration_limit", "line_search_failed", "not_finite", "interrupted"]


class SolverOptions(Options):
    """Options of both solvers.

    Attributes:
        kind: L-BFGS, or Levenberg-Marquardt for comparison.
        max_iterations: A fit that reaches it is reported as not converged.
        tolerance: The fit has converged when the step left to the optimum is below this many
            standard errors of the parameters.
    """

    kind: Literal["lbfgs", "levenberg_marquardt"] = "lbfgs"
    max_iterations: PositiveInt = 200
    tolerance: PositiveFloat = 1e-6


@dataclass(frozen=True)
class Solution:
    """The state of a fit: after each iteration, and at its end.

    Attributes:
        parameters: The best point found; on failure the last good one.
        history: The loss, the sum of weighted squared residuals, at the start and after each
            iteration.
        step_left: Length of the step left to the optimum, in standard errors.
        stopped: Why the solver stopped; only "converged" is convergence. None: it has not yet.
        evaluations: How often the loss was evaluated.
    """

    parameters: Parameters
    history: tuple[float, ...] = ()
    step_left: float = math.inf
    stopped: Stopped | None = None
    evaluations: int = 0

    @property
    def loss(self) -> float:
        """The latest loss."""
        return self.history[-1] if self.history else math.inf

    @property
    def iterations(self) -> int:
        """How many iterations it took; 0 at the start."""
        return max(len(self.history) - 1, 0)

    @property
    def converged(self) -> bool:
        """Whether the optimum was reached."""
        return self.stopped == "converged"

    @property
    def message(self) -> str:
        """The reason for stopping in one sentence."""
        left = f"the step left is {self.step_left:.1e} standard errors."
        return {
            "converged": f"Converged: {left}",
            "iteration_limit": f"Not converged: stopped at {self.iterations} iterations, {left}",
            "line_search_failed": f"The line search failed; rolled back to the best point, {left}",
            "not_finite": "The loss became NaN or infinite; rolled back to the last good point.",
            "interrupted": f"Interrupted after {self.iterations} iterations, {left}",
        }[self.stopped or "line_search_failed"]


Watcher = Callable[[Solution], bool | None]
"""Called after each iteration; returning False interrupts the solver."""


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
        options: Solver, iteration limit and tolerance.
        watcher: Called after each iteration; returning False interrupts.

    Returns:
        The best parameters and the reason for stopping. If the loss stops being finite, or the
        line search fails, they are the last good ones, and `stopped` says so.
    """
    if not start.size:  # There is nothing to estimate.
        return Solution(start, (float(objective.loss(start)),), 0.0, "converged", 1)
    options = options or SolverOptions()
    run = _Run(objective, start, options, watcher)
    {"lbfgs": _lbfgs, "levenberg_marquardt": _levenberg_marquardt}[options.kind](run)
    found = run.found
    return replace(
        found,
        parameters=found.parameters.detached(),
        stopped=found.stopped or "line_search_failed",
        evaluations=run.evaluations,
    )


class _Run:
    """One minimisation: its best point so far, and why it stopped."""

    def __init__(
        self,
        objective: Objective,
        start: Parameters,
        options: SolverOptions,
        watcher: Watcher | None,
    ) -> None:
        self.objective, self.options, self.watcher = objective, options, watcher
        self.found, self.evaluations = Solution(start), 0

    def reached(self, parameters: Parameters, loss: float, step_left: float) -> bool:
        """Take note of an iteration; return whether that is the end."""
        self.found = Solution(parameters, (*self.found.history, loss), step_left)
        stopped: Stopped | None = None
        if self.watcher is not None and self.watcher(self.found) is False:
            stopped = "interrupted"
        elif step_left <= self.options.tolerance:
            stopped = "converged"
        elif self.found.iterations >= self.options.max_iterations:
            stopped = "iteration_limit"
        self.found = replace(self.found, stopped=stopped)
        return stopped is not None

    def equations(self, parameters: Parameters) -> NormalEquations | None:
        """Return the normal equations at a point; None where they are not finite."""
        self.evaluations += 1
        found = self.objective.normal_equations(parameters)
        return found if found.is_finite else None

    def latest(self) -> NormalEquations | None:
        """Return the normal equations at the best point; None where that is the end."""
        if (equations := self.equations(self.found.parameters)) is None:
            self.found = replace(self.found, stopped="not_finite")
        return equations

    def variance(self, equations: NormalEquations, loss: float) -> float:
        """Return the mean weighted squared residual, on which standard errors are based."""
        # The largest curvature is that of an unknown that moves every residual by about one metre.
        least = LEAST_RESIDUAL**2 * float(equations.hessian.diagonal().max())
        return max(loss, least) / self.objective.num_residuals


def _lbfgs(run: _Run) -> None:
    """Minimise by L-BFGS; where a line search stalls, it starts again from there, three times."""
    for _ in range(4):
        if run.found.stopped is None:
            _descend(run)


def _descend(run: _Run) -> None:
    """Run L-BFGS from the best point, whitened there."""
    from scipy.optimize import minimize  # A quarter of the time of torch to import.

    origin, equations = run.found.parameters, run.latest()
    if equations is None:
        return
    loss = float(equations.loss)
    variance = run.variance(equations, loss)
    white = whitening(equations.hessian / variance)
    gradient = white.T @ equations.gradient / variance
    if not run.found.history and run.reached(origin, loss, float(gradient.norm())):
        return
    zero = np.zeros(origin.size)
    seen: list[tuple[np.ndarray, float, np.ndarray]] = [(zero, 0.0, gradient.numpy())]

    def change(z: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the change of the loss since the origin over twice the residual variance."""
        if not np.array_equal(z, seen[-1][0]):
            run.evaluations += 1
            point = torch.from_numpy(z.copy()).requires_grad_()
            found = run.objective.change(origin, white @ point) / (2 * variance)
            (slope,) = torch.autograd.grad(found, point)
            seen.append((z.copy(), float(found.detach()), slope.numpy()))
        return seen[-1][1:]

    def iterated(z: np.ndarray) -> None:
        """Take note of a point; the whitened gradient is the step left in standard errors."""
        value, slope = change(z)
        if not math.isfinite(value):
            raise StopIteration
        loss_here = loss + 2 * variance * value
        left = math.sqrt(variance / run.variance(equations, loss_here))
        here = origin.moved(white @ torch.from_numpy(z.copy()))
        if run.reached(here, loss_here, left * float(np.linalg.norm(slope))):
            raise StopIteration

    options = {"maxcor": 20, "maxls": 25, "ftol": 0.0, "gtol": 0.0}
    minimize(change, zero, jac=True, method="L-BFGS-B", callback=iterated, options=options)


def _levenberg_marquardt(run: _Run) -> None:
    """Minimise by damped Gauss-Newton steps on the normal equations."""
    here, equations, damping = run.found.parameters, run.latest(), ROUNDING**0.5
    while equations is not None:
        loss, gradient = float(equations.loss), equations.gradient
        decrease = float(gradient @ solved(equations.hessian, gradient))
        left = math.sqrt(max(decrease, 0.0) / run.variance(equations, loss))
        if run.reached(here, loss, left):
            return
        origin, hessian, equations = here, equations.hessian, None
        # Beyond that, a step is too short to change the loss.
        while equations is None and damping * ROUNDING < 1:
            step = -solved(hessian, gradient, damping)
            here = origin.moved(step)
            equations = run.equations(here) if run.objective.change(origin, step) <= 0 else None
            damping *= 10
        damping = max(damping / 100, torch.finfo(torch.float64).eps)


def curved(hessian: Float[Tensor, "P P"]) -> Bool[Tensor, "P"]:
    """Return which unknowns change the loss.

    A turn about the only ray does not, nor the coefficient of a condition that never changed. Such
    an unknown stays where it is: whatever is solved for it is rounding over almost zero.
    """
    diagonal = hessian.diagonal()
    # Unknowns are metres and radians: the weakest that any recording resolves is far above it.
    return diagonal > ROUNDING**2 * diagonal.max()


def whitening(hessian: Float[Tensor, "P P"]) -> Float[Tensor, "P P"]:
    """Return W, shape (P, P), with W^T H W = 1 on every direction that float64 resolves.

    The rows of unknowns without any curvature are zero.
    """
    used = curved(hessian)
    blank = torch.where(used[:, None] & used, hessian, 0.0) + torch.diag((~used).to(hessian))
    factored = Curvature(blank)
    values = factored.values.clamp(min=ROUNDING * float(factored.values.max()))
    whitened = factored.scale[:, None] * factored.vectors * values.rsqrt()
    return torch.where(used[:, None], whitened, 0.0)


def initial_parameters(
    moments: ImageMoments, guess: Float[Tensor, "4 4"] | None = None
) -> Parameters:
    """Return a start that needs no guess of the hand-eye: its rotation from plane normals.

    Args:
        moments: Moments of the images.
        guess: A transform for directions that the images do not determine, shape (4, 4); None:
            the identity.
    """
    guess = torch.eye(4, dtype=torch.float64) if guess is None else guess.to(torch.float64)
    normals = plane_normals_camera(moments)
    rotation = rotation_from_normals(moments.normal_tool, normals, guess[:3, :3])
    zero = torch.zeros(moments.num_coefficients, dtype=torch.float64)
    return with_linear_part(moments, Parameters(se3.assemble(rotation, guess[:3, 3]), zero))


def plane_normals_camera(moments: ImageMoments) -> Float[Tensor, "N 3"]:
    """Fit a plane to the raw points of each image, from its moments.

    Returns:
        Unit normals in the camera frame, on the camera's side of the plane, shape (N, 3).
    """
    points = moments.gram / moments.gram[:, -1:, -1:].clamp(min=torch.finfo(torch.float64).tiny)
    mean = points[:, -1, :3]
    covariance = points[:, :3, :3] - mean[:, :, None] * mean[:, None, :]
    normal = torch.linalg.eigh(covariance).eigenvectors[..., 0]
    # The camera is the origin: it lies at signed distance -n.mean, which must be positive.
    facing = torch.where((normal * mean).sum(-1) > 0, -1.0, 1.0)
    return normal * facing[:, None]


def rotation_from_normals(
    normal_tool: Float[Tensor, "N 3"],
    normal_camera: Float[Tensor, "N 3"],
    guess: Float[Tensor, "3 3"],
) -> Float[Tensor, "3 3"]:
    """Return the rotation tool_from_camera that best turns camera normals into tool normals.

    Args:
        normal_tool: Unit normals in the tool frame, shape (N, 3).
        normal_camera: The same normals in the camera frame, shape (N, 3).
        guess: A rotation, shape (3, 3); decides the turn about the normal where all normals are
            parallel. It weighs a millionth of an image.
    """
    u, _, vh = torch.linalg.svd(normal_tool.T @ normal_camera + 1e-6 * guess)
    sign = torch.ones(3, dtype=u.dtype)
    sign[2] = torch.det(u @ vh).sign()
    return u @ torch.diag(sign) @ vh


def with_linear_part(moments: ImageMoments, start: Parameters) -> Parameters:
    """Solve for translation and coefficients with the rotation fixed: one least-squares problem.

    With a fixed hand-eye only the coefficients are solved for. Directions that the images do not
    determine keep the values of `start`.
    """
    equations = MomentObjective(moments).normal_equations(start)
    solved_for = curved(equations.hessian) if start.size else torch.zeros(0, dtype=torch.bool)
    if start.hand_eye_is_free:
        solved_for[3:6] = False  # The rotation.
    linear = torch.nonzero(solved_for)[:, 0]
    if not len(linear):
        return start
    factored = Curvature(equations.hessian[linear[:, None], linear])
    solution = -(factored.inverse @ equations.gradient[linear])
    # The solution of least length in metres. In scaled units an undetermined translation, whose own
    # scale is almost zero, would take most of the others' steps.
    free = factored.scale[:, None] * factored.vectors[:, ~factored.resolved]
    undetermined = torch.linalg.qr(free).Q
    step = torch.zeros(start.size, dtype=torch.float64)
    step[linear] = solution - undetermined @ (undetermined.T @ solution)
    return start.moved(step).detached()
