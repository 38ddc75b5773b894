"""Fits one model to some frames of a data set, in named steps."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from tofcorr.correction.model import CalibrationModel, HandEye
from tofcorr.error_terms.base import Domain
from tofcorr.error_terms.model import ErrorModel, ErrorModelOptions
from tofcorr.errors import CalibrationDataError
from tofcorr.estimation.linear import solvable
from tofcorr.estimation.moments import ImageMoments, Parameters
from tofcorr.estimation.noise import DistanceNoise
from tofcorr.estimation.planes import Walls, estimate_walls
from tofcorr.estimation.solvers import Watcher
from tofcorr.estimation.uncertainty import jackknife_covariance
from tofcorr.fit.core import Core, Held, hold, minimise, solve
from tofcorr.fit.noise_shift import NoiseShift, noise_of, without_noise_shift
from tofcorr.fit.problem import FitOptions, Problem, Start, build_model
from tofcorr.fit.residual import (
    FittedCore,
    ResidualOutcome,
    fit_residual,
)
from tofcorr.fit.result import Fit
from tofcorr.fit.walls import FoundWalls, name_walls, recorded_walls
from tofcorr.fit.weighting import PixelWeights, first_weights, weighted_moments
from tofcorr.pixels.dataset import Dataset, resolved_planes, thread_number
from tofcorr.pixels.sample import cosine_of_incidence, distance_to_plane, draw_pixels


def fixed_pattern(
    dataset: Dataset,
    frames: Sequence[int] | np.ndarray,
    model: CalibrationModel,
    spread: float | None = None,
    device: str = "cpu",
) -> tuple[Tensor, float]:
    """Return the pixels' offsets (H, W) in metres, and their standard deviation.

    Args:
        dataset: The recordings.
        frames: Global numbers of the frames fitted.
        model: The fitted model; its own pattern must be zero.
        spread: Standard deviation tau of the offsets, metres; None: from the data, as the variance
            of the means beyond their own uncertainty (empirical Bayes).
        device: Where to compute.
    """
    rays = dataset.ray_directions()
    # Sums over the frames: c r, c^2, r^2 and the count.
    total = rays.new_zeros(4, *rays.shape[:2])
    for batch in dataset.batches(frames, device):
        here = rays.to(device)
        found = distance_to_plane(model, batch, here)
        cosine = cosine_of_incidence(model, batch, here)
        sums = torch.stack([cosine * found, cosine**2, found**2, torch.ones_like(found)])
        total += (sums * batch.valid.to(found)).sum(dim=1).cpu()
    product, square, residual, number = total
    seen = square > 0
    mean = torch.where(seen, product / square.clamp(min=1e-300), 0.0)
    within = (residual - mean * product).clamp(min=0)
    variance = within.sum() / (number - 1).clamp(min=0).sum().clamp(min=1)
    own = torch.where(seen, variance / square.clamp(min=1e-300), torch.inf)
    if spread is None:
        excess = mean[seen].square().mean() - own[seen].mean() if bool(seen.any()) else mean.sum()
        spread = float(excess.clamp(min=0).sqrt())
    return mean * spread**2 / (spread**2 + own).clamp(min=1e-300), spread


def with_pattern(problem: Problem, core: Core) -> CalibrationModel:
    """Return the model of a fitted core, with its fixed pattern if the options ask for one."""
    error = core.error_model(problem.domain)
    model = calibrated(error, core.solution.parameters)
    if error.fixed_pattern is not None:
        spread = error.fixed_pattern.options.spread_mm  # type: ignore[attr-defined]
        known = None if spread == "auto" else spread * 1e-3
        device = problem.options.device
        offset, _ = fixed_pattern(problem.dataset, problem.frames, model, known, device)
        error.fixed_pattern.offset.copy_(offset)
    return model


def refuse_diverged(parameters: Parameters) -> None:
    """Refuse a hand-eye transform that the solver moved so far that it is no rotation any more.

    Raises:
        CalibrationDataError: The frames do not determine it, and its estimate grew without bounds.
    """
    rotation = parameters.tool_from_camera[:3, :3].detach()
    off = rotation @ rotation.T - torch.eye(3).to(rotation)
    # Rounding makes 1e-15 for a step of any sensible size; only one of a million turns makes more.
    if bool((off.abs() < 1e-6).all()):
        return
    raise CalibrationDataError(
        "The frames do not determine the hand-eye transform: its estimate grew without bounds. "
        "Record more poses, near and far and tilted to all sides, or choose a model of fewer terms."
    )


def calibrated(error: ErrorModel, parameters: Parameters) -> CalibrationModel:
    """Join an error model, its coefficients set, and the hand-eye transform of the parameters."""
    hand_eye = HandEye(fixed=not parameters.hand_eye_is_free)
    hand_eye.rebase(parameters.tool_from_camera)
    return CalibrationModel(error, hand_eye)


def completed(
    problem: Problem, held: Held, weights: PixelWeights | None
) -> tuple[
    Problem, Core, CalibrationModel, ResidualOutcome | None, DistanceNoise | None, NoiseShift | None
]:
    """Decide on the residual network, take the noise's shift off, and add the fixed pattern.

    Returns:
        The problem, on the walls that go with the core; the core, without what the noise of the
        distances moves; its model, with fixed pattern and network; how the network was decided on,
        the noise and what it moves, each None if unknown.
    """
    noise, outcome = noise_of(problem, weights), None
    residual, core = problem.options.residual, held.core
    if residual is not None:
        error, frames = with_pattern(problem, core).error, np.sort(problem.frames)
        outcome = fit_residual(
            FittedCore(error, core.moments, core.solution.parameters, core.smoothness),
            draw_pixels(problem.dataset, frames, residual.pixels, residual.network.seed),
            problem.dataset.pose_groups()[frames],
            problem.domain,
            residual,
        )
        if outcome.network is not None:
            error.residual = outcome.network
            error.set_coefficient_vector(outcome.parameters.coefficients)
            model = calibrated(error, outcome.parameters)
            _, core, shift = without_noise_shift(problem, held, weights, noise, network=True)
            return problem, core, model, outcome, noise, shift
    problem, core, shift = without_noise_shift(problem, held, weights, noise, network=False)
    return problem, core, with_pattern(problem, core), outcome, noise, shift


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
        return completed(problem, held, weights)[2]


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
        problem, moments = on_found_walls(problem, held.core, moments)
        held = hold(problem, solve(problem, moments))
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


def find_walls(dataset: Dataset, frames: Sequence[int] | np.ndarray, core: Core) -> FoundWalls:
    """Estimate the walls of some frames together with the unknowns of a fitted core.

    Args:
        dataset: The recordings.
        frames: Global numbers of the frames.
        core: Fitted to them with the walls as recorded.

    Raises:
        CalibrationDataError: A wall has fewer than three of the frames.
    """
    named = name_walls(dataset)
    walls, numbers = recorded_walls(dataset, frames, named)
    best = core.solution.parameters
    prior = None if core.smoothness is None else core.smoothness.equations(best)
    _, walls = estimate_walls(core.moments, best, walls, prior)
    return FoundWalls(named, walls, numbers)


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
    problem, core, model, outcome, noise, shift = completed(problem, held, weights)
    solution = core.solution
    if outcome is not None and outcome.kept:
        optimum = outcome.parameters
        solution = replace(solution, parameters=optimum)
    return Fit(
        model=model,
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
        noise=noise,
        noise_shift=shift,
    )


def without_terms(problem: Problem, moments: ImageMoments) -> Parameters:
    """Fit the hand-eye transform alone to moments."""
    geometry = moments.columns([])
    bare = problem.start.resumed_at(None)(geometry)
    parameters = minimise(geometry, bare, problem.options.solver).parameters
    refuse_diverged(parameters)
    return parameters
