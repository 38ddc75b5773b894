"""Where a fit starts, and how it finds the least loss: by damped Gauss-Newton steps.

They are damped in proportion to the curvature of each unknown (Levenberg and Marquardt), so that
metres, radians and coefficients need no common scale. A fit ends by the step that is left to the
optimum, in standard errors, and not by the residual: on raw parameters a search along gradients
stops while the hand-eye is still millimetres off, at an almost perfect residual.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import torch
from jaxtyping import Bool, Float
from pydantic import PositiveFloat, PositiveInt
from torch import Tensor

from tofcorr.estimation.linear import RESOLVED, ROUNDING, Curvature
from tofcorr.estimation.moments import LEAST_RESIDUAL, ImageMoments, MomentObjective, Parameters
from tofcorr.geometry import se3
from tofcorr.geometry.rays import planes_through
from tofcorr.options import Options

Stopped = Literal["converged", "iteration_limit", "line_search_failed", "not_finite", "interrupted"]


class SolverOptions(Options):
    """Options of the solver.

    Attributes:
        kind: Both names mean the same solver; older configurations name one of them.
        max_iterations: A fit that reaches it is reported as not converged.
        tolerance: The fit has converged when the step left to the optimum is below this many
            standard errors of the parameters.
    """

    kind: Literal["levenberg_marquardt", "lbfgs"] = "levenberg_marquardt"
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
    """

    parameters: Parameters
    history: tuple[float, ...] = ()
    step_left: float = math.inf
    stopped: Stopped | None = None

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
    objective: MomentObjective,
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
        The best parameters and the reason for stopping. If the loss stops being finite, or no step
        reduces it, they are the last good ones, and `stopped` says so.
    """
    options, here = options or SolverOptions(), start.detached()
    equations = tried = objective.normal_equations(here)
    if not start.size:  # There is nothing to estimate.
        return Solution(here, (float(equations.loss),), 0.0, "converged")
    found, damping = Solution(here), ROUNDING**0.5
    count = float(objective.moments.count.sum().clamp(min=1))
    while equations.is_finite:
        loss, hessian = float(equations.loss), equations.hessian
        moves = curved(hessian)
        kept = torch.where(moves[:, None] & moves, hessian, 0.0) + (~moves).to(hessian).diag()
        curvature = Curvature(kept)
        along = curvature.vectors.T @ torch.where(moves, curvature.scale * equations.gradient, 0.0)
        # The largest curvature is that of an unknown that moves every residual by about one metre.
        # So large are the sums of squared distances of which the loss is what is left.
        summed = float(hessian.diagonal().max())
        variance = max(loss, LEAST_RESIDUAL**2 * summed) / count
        decrease = float((along.square() / curvature.values.clamp(min=ROUNDING)).sum())
        found = Solution(here, (*found.history, loss), math.sqrt(decrease / variance))
        if stopped := _stopped(found, options, watcher):
            return replace(found, stopped=stopped)
        # Beyond that, a step is too short to change the loss.
        while damping * ROUNDING < 1:
            damped = along / (curvature.values.clamp(min=0.0) + damping)
            here = found.parameters.moved(-curvature.scale * (curvature.vectors @ damped))
            tried, damping = objective.normal_equations(here), damping * 10
            if float(tried.loss) <= loss + ROUNDING * summed:
                break
        else:
            break
        equations, damping = tried, max(damping / 100, ROUNDING)
    return replace(found, stopped="line_search_failed" if tried.is_finite else "not_finite")


def _stopped(found: Solution, options: SolverOptions, watcher: Watcher | None) -> Stopped | None:
    """Return why an iteration is the last one; None: it is not."""
    if watcher is not None and watcher(found) is False:
        return "interrupted"
    if found.step_left <= options.tolerance:
        return "converged"
    return "iteration_limit" if found.iterations >= options.max_iterations else None


def curved(hessian: Float[Tensor, "P P"]) -> Bool[Tensor, "P"]:
    """Return which unknowns change the loss.

    A turn about the only ray does not, nor the coefficient of a condition that never changed. Such
    an unknown stays where it is: whatever is solved for it is rounding over almost zero.
    """
    diagonal = hessian.diagonal()
    # Unknowns are metres and radians: the weakest that any recording resolves is far above it.
    return diagonal > ROUNDING**2 * diagonal.max()


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
    # The camera is the origin. Points have the entries x, y, z and 1.
    points = moments.gram[:, [0, 1, 2, -1]][:, :, [0, 1, 2, -1]]
    normals, _ = planes_through(points, torch.zeros(3, dtype=torch.float64))
    rotation = rotation_from_normals(moments.normal_tool, normals, guess[:3, :3])
    zero = torch.zeros(len(moments.symbols), dtype=torch.float64)
    return with_linear_part(moments, Parameters(se3.assemble(rotation, guess[:3, 3]), zero))


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
            parallel. It weighs as little as rounding may.
    """
    u, _, vh = torch.linalg.svd(normal_tool.T @ normal_camera + RESOLVED * guess)
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
