"""Fits one model to some frames of a data set, in named steps."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from tofcorr.correction.model import CalibrationModel
from tofcorr.error_terms.domain import Domain
from tofcorr.error_terms.model import ErrorModelOptions
from tofcorr.estimation.covariance import jackknife_covariance
from tofcorr.estimation.linear import solvable
from tofcorr.estimation.moments import ImageMoments
from tofcorr.estimation.parameters import Parameters
from tofcorr.estimation.planes import Walls
from tofcorr.estimation.solution import Watcher
from tofcorr.fit.assemble import calibrated, completed, refuse_diverged
from tofcorr.fit.core import Core, minimise, solve_core
from tofcorr.fit.hold import Held, hold
from tofcorr.fit.inputs import build_model
from tofcorr.fit.options import FitOptions
from tofcorr.fit.problem import Problem
from tofcorr.fit.result import Fit
from tofcorr.fit.start import Start
from tofcorr.fit.unknown_walls import find_walls, name_walls, recorded_walls
from tofcorr.fit.weighting import PixelWeights, first_weights, weighted_moments
from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.plane_choice import resolved_planes
from tofcorr.pixels.threads import thread_number


def fit(
    dataset: Dataset,
    frames: Sequence[int] | np.ndarray,
    options: FitOptions,
    domain: Domain,
    watcher: Watcher | None = None,
    resumed: Parameters | None = None,
    moments: ImageMoments | None = None,
) -> Fit:
    """Fit one model to some frames: one pass over the pixels, then the solver on the moments.

    A direction that the images do not determine is held near the start by a weak prior, or
    refused, as the options say.

    Where the noise of the measured distances is known, what it moves is taken off the estimate, as
    `noise_shift` says.

    Args:
        dataset: The recordings.
        frames: Global numbers of the frames to fit.
        options: Model, hand-eye, solver and device.
        domain: The ranges that scale the model's variables.
        watcher: Called after each iteration of the solver.
        resumed: Where an interrupted fit stood; None starts anew.
        moments: Those of the frames with exactly the model's image columns, if they are known
            from an earlier pass; weighted by noise where the options say so, but not robustly.

    Raises:
        CalibrationDataError: The recordings lack an input of the model, the images do not
            determine a direction and the options refuse that, or they determine nothing.
    """
    with solvable(dataset.first.path, "fit"), thread_number(1):
        start = Start.of(dataset, options.hand_eye, resumed)
        problem = Problem(dataset, np.asarray(frames), options, domain, start, watcher)
        return finish(*solved(problem, moments))


def fit_model(
    dataset: Dataset, frames: Sequence[int] | np.ndarray, options: FitOptions, domain: Domain
) -> CalibrationModel:
    """Return the model that `fit` finds, without its covariance; arguments and errors as there."""
    with solvable(dataset.first.path, "fit"), thread_number(1):
        start = Start.of(dataset, options.hand_eye)
        problem = Problem(dataset, np.asarray(frames), options, domain, start)
        problem, held, weights = solved(problem)
        refuse_diverged(held.core.solution.parameters)
        return completed(problem, held, weights).model


def fit_hand_eye(
    dataset: Dataset, frames: Sequence[int] | np.ndarray, options: FitOptions, domain: Domain
) -> Parameters:
    """Fit the hand-eye transform alone, on the planes as recorded and without any error term.

    Arguments and errors are those of `fit`; the terms of the options are not used.
    """
    with solvable(dataset.first.path, "fit"), thread_number(1):
        none = options.model_copy(update={"model": ErrorModelOptions(terms=())})
        start = Start.of(dataset, options.hand_eye)
        problem = Problem(dataset, np.asarray(frames), none, domain, start)
        return without_terms(problem, prepare(problem)[0])


def solved(
    problem: Problem, moments: ImageMoments | None = None
) -> tuple[Problem, Held, PixelWeights | None]:
    """Take all steps to the fitted core.

    Args:
        problem: What to fit.
        moments: As in `fit`.

    Returns:
        The problem, on the walls found where they are unknown, its core, and the pixels' weights.
    """
    weights = None
    if moments is None:
        moments, weights = prepare(problem)
    elif problem.options.weights.noise:
        weights = first_weights(problem.dataset, problem.frames, noise=True, loss="none")
    held = hold(problem, solve(problem, moments))
    if resolved_planes(problem.options.planes, problem.dataset.recordings) == "unknown":
        problem, held = estimate_walls(problem, held, moments)
    return problem, held, weights


def prepare(problem: Problem) -> tuple[ImageMoments, PixelWeights | None]:
    """Read the pixels once, or once for each pass of robust weights.

    Returns:
        The moments of the frames, and the weights of the pixels; None if all have the same.
    """
    options, quiet = problem.options, replace(problem, watcher=None)
    walls = recorded_walls_of(problem)

    def on_recorded_walls(moments: ImageMoments) -> ImageMoments:
        return moments if walls is None else walls.seen_by(moments)

    def modelled(moments: ImageMoments) -> tuple[CalibrationModel, Dataset]:
        here, moments = quiet, on_recorded_walls(moments)
        core = solve(here, moments)
        if walls is not None:
            # Distances to a plane that is a mere guess would make every pixel an outlier.
            here, moments = on_found_walls(here, core, moments)
            core = solve(here, moments)
        model = calibrated(core.error_model(problem.domain), core.solution.parameters)
        return model, here.dataset

    _, design = build_model(problem.dataset, options.model, problem.domain)
    moments, weights = weighted_moments(
        problem.dataset, problem.frames, design, options.weights, modelled, options.device
    )
    return on_recorded_walls(moments), weights


def recorded_walls_of(problem: Problem) -> Walls | None:
    """Return the walls as recorded if they are a mere start; None if they are known."""
    if resolved_planes(problem.options.planes, problem.dataset.recordings) == "known":
        return None
    named = name_walls(problem.dataset)
    return recorded_walls(problem.dataset, problem.frames, named)[0]


def solve(problem: Problem, moments: ImageMoments) -> Core:
    """Find the hand-eye transform and the coefficients that minimise the loss of the moments."""
    return solve_core(
        moments,
        problem.conditions(),
        problem.poses(),
        problem.options.model,
        problem.domain,
        problem.start,
        problem.options.solver,
        problem.watcher,
    )


def estimate_walls(problem: Problem, held: Held, moments: ImageMoments) -> tuple[Problem, Held]:
    """Estimate the walls from the fit on the recorded ones, and solve again on the walls found.

    Returns:
        The problem on the walls found, and its fitted core.
    """
    found, moments = on_found_walls(problem, held.core, moments)
    return found, hold(found, solve(found, moments))


def on_found_walls(
    problem: Problem, core: Core, moments: ImageMoments
) -> tuple[Problem, ImageMoments]:
    """Estimate the walls with the unknowns of a core; return problem and moments on them."""
    walls = find_walls(problem.dataset, problem.frames, core)
    start = problem.start.resumed_at(core.solution.parameters)
    return problem.with_walls(walls, start), walls.walls.seen_by(moments)


def finish(problem: Problem, held: Held, weights: PixelWeights | None) -> Fit:
    """Add covariance, the hand-eye transform alone, fixed pattern and residual network.

    What the noise of the distances moves is taken off the estimate.
    """
    optimum, walls = held.core.solution.parameters, problem.walls
    refuse_diverged(optimum)
    # At the least loss, where the gradients of the poses sum to zero.
    covariance = jackknife_covariance(
        held.core.moments,
        optimum,
        held.total_prior,
        problem.numbered_poses(),
        None if walls is None else walls.walls,
    )
    hand_eye_only = without_terms(problem, held.core.moments)
    whole = completed(problem, held, weights)
    problem, core, outcome = whole.problem, whole.core, whole.residual
    solution = core.solution
    if outcome is not None and outcome.kept:
        optimum = outcome.parameters
        solution = replace(solution, parameters=optimum)
    return Fit(
        model=whole.model,
        domain=problem.domain,
        solution=solution,
        optimum=optimum,
        hand_eye_only=hand_eye_only,
        covariance=covariance,
        moments=core.moments,
        observability=held.observability,
        prior=held.prior,
        total_prior=held.total_prior,
        poses=problem.numbered_poses(),
        options=core.options,
        residual=outcome,
        weights=weights,
        walls=problem.walls,
        noise=whole.noise,
        noise_shift=whole.shift,
    )


def without_terms(problem: Problem, moments: ImageMoments) -> Parameters:
    """Fit the hand-eye transform alone to moments."""
    geometry = moments.columns([])
    bare = problem.start.resumed_at(None)(geometry)
    parameters = minimise(geometry, bare, problem.options.solver).parameters
    refuse_diverged(parameters)
    return parameters
