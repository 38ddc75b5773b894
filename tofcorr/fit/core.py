"""Solves for hand-eye and coefficients of one model from moments."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from tofcorr.conditions import CONDITIONS
from tofcorr.error_terms.base import Domain, Term
from tofcorr.error_terms.model import ErrorModel, ErrorModelOptions
from tofcorr.error_terms.registry import TermOptions
from tofcorr.errors import CalibrationDataError
from tofcorr.estimation import solvers
from tofcorr.estimation.moments import (
    ImageMoments,
    MomentObjective,
    Objective,
    Parameters,
    Prior,
    WithPrior,
)
from tofcorr.estimation.regularisation import (
    penalties_of,
    smoothness,
    time_constant,
    total_weight,
    with_strengths,
)
from tofcorr.estimation.solvers import Solution, SolverOptions, Watcher
from tofcorr.estimation.uncertainty import (
    Observability,
    effective_variance,
    observability,
    prior_on_undetermined,
)
from tofcorr.fit.problem import Problem


@dataclass(frozen=True)
class Core:
    """The parametric part of a fit: hand-eye and coefficients, without residual network.

    Attributes:
        options: The terms, with numbers in place of `auto`.
        moments: The moments of the images fitted, with the columns of the condition terms.
        start: Where the solver started.
        solution: The parameters found, and why the solver stopped.
        smoothness: The smoothing penalties as a prior; None if no term is penalised.
    """

    options: ErrorModelOptions
    moments: ImageMoments
    start: Parameters
    solution: Solution
    smoothness: Prior | None

    def error_model(self, domain: Domain) -> ErrorModel:
        """Build the error model with the coefficients found."""
        model = ErrorModel(self.options, domain)
        model.set_coefficient_vector(self.solution.parameters.coefficients)
        return model


def minimise(
    moments: ImageMoments,
    start: Parameters,
    options: SolverOptions,
    watcher: Watcher | None = None,
    prior: Prior | None = None,
) -> Solution:
    """Minimise the point-to-plane loss of the moments with the solver that the options name."""
    objective: Objective = MomentObjective(moments)
    if prior is not None:
        objective = WithPrior(objective, prior)
    return solvers.minimise(objective, start, options, watcher)


def solve(problem: Problem, moments: ImageMoments, folds: int = 6) -> Core:
    """Find the hand-eye transform and the coefficients that minimise the loss of the moments.

    Args:
        problem: What to fit.
        moments: Of its frames, with exactly the model's image columns.
        folds: Of the cross-validation that chooses the strength of a penalty; poses go to them in
            turn, with all their images.
    """
    conditions, solver = problem.conditions(), problem.options.solver
    options = problem.options.model
    if any(_is_open(term) for term in options.terms):
        around = minimise(moments, problem.start(moments), solver).parameters
        found = time_constant(moments, around, conditions[:, CONDITIONS.index("timestamp")])
        options = _changed(options, _is_open, lambda _: {"time_constants_s": (found,)})
    model = ErrorModel(options, problem.domain)
    moments = with_condition_columns(moments, model, conditions)
    first = _start(moments, model, problem.start)
    _, pose = np.unique(problem.poses(), return_inverse=True)
    held_out = [np.flatnonzero(pose % folds == k).tolist() for k in range(folds)]
    penalties = with_strengths(penalties_of(model), moments, first, held_out)
    strengths = {one.name: float(one.strength) for one in penalties}
    in_order = iter([strengths[term.symbols[0]] for term, _ in model.penalised()])
    options = _changed(options, _has_strength, lambda _: {"strength": next(in_order)})
    prior = smoothness(penalties, total_weight(moments), first)
    solution = minimise(moments, first, solver, problem.watcher, prior)
    return Core(options, moments, first, solution, prior)


def _start(
    moments: ImageMoments, model: ErrorModel, start: Callable[[ImageMoments], Parameters]
) -> Parameters:
    """Start penalised curves at zero: without the penalty the images hardly determine them."""
    penalised = {symbol for term, _ in model.penalised() for symbol in term.symbols}
    if not penalised:
        return start(moments)
    others = [symbol for symbol in moments.symbols if symbol not in penalised]
    found = start(moments.columns(others))
    coefficients = torch.zeros(moments.num_coefficients, dtype=torch.float64)
    coefficients[[moments.symbols.index(symbol) for symbol in others]] = found.coefficients
    return replace(found, coefficients=coefficients)


def with_condition_columns(
    moments: ImageMoments, model: ErrorModel, conditions: Tensor
) -> ImageMoments:
    """Return the moments with the columns of the model's condition terms."""
    terms: list[Term] = list(model.condition_terms)  # type: ignore[arg-type]
    if not terms:
        return moments
    functions = torch.cat([term.basis(conditions) for term in terms])  # type: ignore[operator]
    symbols = [symbol for term in terms for symbol in term.symbols]
    return moments.with_conditions(functions.T, symbols)


def _is_open(term: TermOptions) -> bool:
    return term.is_open("time_constants_s")


def _has_strength(term: TermOptions) -> bool:
    return "strength" in term.found_in_data


def _changed(
    options: ErrorModelOptions,
    concerned: Callable[[TermOptions], bool],
    update: Callable[[TermOptions], dict[str, object]],
) -> ErrorModelOptions:
    """Return the options with values found in the data in the terms that they concern."""
    terms = (
        term.model_copy(update=update(term)) if concerned(term) else term for term in options.terms
    )
    return options.model_copy(update={"terms": tuple(terms)})


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
