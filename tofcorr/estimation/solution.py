"""What a solver returns: the parameters found, and why it stopped."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

from pydantic import PositiveFloat, PositiveInt

from tofcorr.estimation.parameters import Parameters
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
class Iteration:
    """One iteration as the monitor sees it.

    Attributes:
        number: Counted from 0, the start.
        loss: Sum of weighted squared residuals.
        step_left: Length of the step left to the optimum, in standard errors.
        parameters: The current parameters.
    """

    number: int
    loss: float
    step_left: float
    parameters: Parameters


Watcher = Callable[[Iteration], bool | None]
"""Called after each iteration; returning False interrupts the solver."""


@dataclass(frozen=True)
class Solution:
    """The end of a fit.

    Attributes:
        parameters: The best point found; on failure the last good one.
        loss: Its loss.
        stopped: Why the solver stopped; only "converged" is convergence.
        iterations: How many iterations it took.
        evaluations: How often the loss was evaluated.
        message: The reason in one sentence.
        history: Every iteration's loss.
    """

    parameters: Parameters
    loss: float
    stopped: Stopped
    iterations: int
    evaluations: int
    message: str
    history: list[float] = field(default_factory=list)

    @property
    def converged(self) -> bool:
        """Whether the optimum was reached."""
        return self.stopped == "converged"


def nothing_to_estimate(parameters: Parameters, loss: float) -> Solution:
    """Return the end of a fit without unknowns: the hand-eye is fixed and there is no term."""
    return Solution(parameters, loss, "converged", 0, 1, "There is nothing to estimate.", [loss])
