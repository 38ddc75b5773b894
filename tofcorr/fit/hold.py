"""Directions that the images do not determine: held by a prior, or refused.

Such a direction is a combination of unknowns along which the loss is flat, for example
t_z against c0 where the camera was never tilted.
"""

from dataclasses import dataclass, replace

from tofcorr.errors import CalibrationDataError
from tofcorr.estimation.information import effective_variance
from tofcorr.estimation.observability import Observability, observability
from tofcorr.estimation.prior import Prior, prior_on_undetermined
from tofcorr.fit.core import Core, minimise
from tofcorr.fit.problem import Problem


@dataclass(frozen=True)
class Held:
    """A fitted core in which every direction is determined, by the images or by a prior.

    Attributes:
        core: The core, solved with the priors.
        observability: How well the images alone determine each direction.
        prior: On the directions that they do not determine; None if there is no such direction.
        total_prior: That prior together with the smoothness of penalised curves; None without
            either.
    """

    core: Core
    observability: Observability
    prior: Prior | None
    total_prior: Prior | None


def hold(problem: Problem, core: Core) -> Held:
    """Look for undetermined directions, and put a prior on them or refuse them.

    Raises:
        CalibrationDataError: There is one, and the options ask to refuse it.
    """
    moments, best, smoothness = core.moments, core.solution.parameters, core.smoothness
    walls = None if problem.walls is None else problem.walls.walls
    if smoothness is not None:
        smoothness = smoothness.rescaled(effective_variance(moments, best))
    found = observability(moments, best, prior=smoothness, walls=walls)
    prior = prior_on_undetermined(found, problem.start.guess(moments))
    if prior is None:
        return Held(core, found, None, smoothness)
    if problem.options.free_directions == "refuse":
        raise CalibrationDataError(
            f"The images do not determine: {'; '.join(prior.names)}. Add views tilted about two "
            "axes and a wider range of distances, keep the recorded hand-eye transform "
            "(hand_eye.estimate: no), or set free_directions: prior."
        )
    total = prior if smoothness is None else prior.joined(smoothness)
    solution = minimise(moments, core.start, problem.options.solver, None, total)
    return Held(replace(core, solution=solution), found, prior, total)
