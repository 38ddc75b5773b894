"""Fits one model to some frames of a data set."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from tofcorr.correction.hand_eye import HandEye
from tofcorr.correction.model import CalibrationModel
from tofcorr.error_terms.domain import Domain
from tofcorr.error_terms.model import ErrorModel, ErrorModelOptions
from tofcorr.errors import CalibrationDataError
from tofcorr.estimation.covariance import Covariance, jackknife_covariance
from tofcorr.estimation.design import Design
from tofcorr.estimation.initial_guess import initial_parameters, with_linear_part
from tofcorr.estimation.moments import ImageMoments
from tofcorr.estimation.objective import MomentObjective
from tofcorr.estimation.observability import Observability, effective_variance, observability
from tofcorr.estimation.parameters import Parameters
from tofcorr.estimation.planes import Walls, estimate_walls
from tofcorr.estimation.prior import Prior, prior_on_free_directions
from tofcorr.estimation.solution import Solution, Watcher
from tofcorr.fit.core import Core, solve, solve_core
from tofcorr.fit.options import FitOptions
from tofcorr.fit.pixel_pattern import fixed_pattern
from tofcorr.fit.residual_fit import FittedCore, ResidualOptions, ResidualOutcome, fit_residual
from tofcorr.fit.residual_sample import sample_for_residual
from tofcorr.fit.unknown_walls import WallNames, name_walls, recorded_walls, with_walls
from tofcorr.fit.weighting import PixelWeights, weighted_moments
from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.hand_eye import HandEyeOptions, hand_eye_is_free, recorded_hand_eye


@dataclass(frozen=True)
class Fit:
    """One fitted model.

    Attributes:
        model: The error model and hand-eye, with the fitted parameters.
        domain: The ranges it was calibrated on.
        solution: How the solver ended.
        hand_eye_only: The best that the hand-eye alone can do, without any depth correction.
        covariance: Uncertainty of the parameters, by leaving out images.
        moments: The moments of the frames fitted.
        observability: What the images leave open, without the prior.
        prior: The belief that stands in for what they leave free; None if nothing is free.
        belief: All that was believed in the fit: the prior, and that curves are smooth.
        poses: The pose of each image fitted, shape (N,), counted from zero.
        options: The model's terms, with what was found in the data where they say `auto`.
        residual: What became of the residual network; None if there was to be none.
        weights: How much each pixel counted; None if all counted alike.
        walls: The walls that were estimated as well; None if those recorded were believed.
    """

    model: CalibrationModel
    domain: Domain
    solution: Solution
    hand_eye_only: Parameters
    covariance: Covariance
    moments: ImageMoments
    observability: Observability
    prior: Prior | None
    belief: Prior | None
    poses: Tensor
    options: ErrorModelOptions
    residual: ResidualOutcome | None = None
    weights: PixelWeights | None = None
    walls: "FoundWalls | None" = None


def build_model(
    dataset: Dataset, options: ErrorModelOptions, domain: Domain
) -> tuple[ErrorModel, Design]:
    """Build an untrained error model on the camera of the data set, and its design.

    Raises:
        CalibrationDataError: The model needs what a recording lacks: amplitudes, the modulation
            frequency, a column of frames.csv.
    """
    refuse_missing_inputs(dataset, options)
    error = ErrorModel(options, domain)
    return error, Design(error, domain, dataset.ray_directions())


def refuse_missing_inputs(dataset: Dataset, options: ErrorModelOptions) -> None:
    """Refuse a recording that lacks what a term looks at, naming file and term.

    Raises:
        CalibrationDataError: As said.
    """
    for term in options.terms:
        for name in term.needs:
            dataset.require(name, f"the term {term.kind}")


def start_parameters(
    moments: ImageMoments, dataset: Dataset, options: HandEyeOptions
) -> Parameters:
    """Return where the solver starts: the better of closed form and the recording's own guess."""
    guess = recorded_hand_eye(dataset)
    zero = torch.zeros(moments.num_coefficients, dtype=torch.float64)
    if not hand_eye_is_free(dataset, options):
        return with_linear_part(moments, Parameters(guess, zero, hand_eye_is_free=False))
    candidates = [with_linear_part(moments, Parameters(guess, zero))]
    if options.start == "auto":
        candidates.append(initial_parameters(moments, guess))
    objective = MomentObjective(moments)
    return min(candidates, key=lambda candidate: float(objective.loss(candidate)))


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

    What the images leave free is held near the start by a weak prior, or refused, as the options
    say.

    Args:
        dataset: The recordings.
        frames: Global numbers of the frames to fit.
        options: Model, hand-eye, solver and device.
        domain: The ranges that scale the model's variables.
        watcher: Called after each iteration of the solver.
        resumed: Where an interrupted fit stood; None starts afresh.
        moments: Those of the frames with exactly the model's image columns, if they are known
            from an earlier pass.

    Raises:
        CalibrationDataError: The images leave a direction free, and the options refuse that.
    """

    def start(moments: ImageMoments) -> Parameters:
        if resumed is not None and resumed.coefficients.numel() == moments.num_coefficients:
            return resumed
        return start_parameters(moments, dataset, options.hand_eye)

    def solved(moments: ImageMoments, watcher: Watcher | None = None) -> Core:
        return solve_core(
            moments,
            dataset.conditions(frames),
            dataset.pose_groups()[np.asarray(frames)],
            options.model,
            domain,
            start,
            options.solver,
            watcher,
        )

    def modelled(moments: ImageMoments) -> CalibrationModel:
        core = solved(moments)
        return calibrated(core.error_model(domain), core.solution.parameters)

    weights = None
    if moments is None:
        _, design = build_model(dataset, options.model, domain)
        moments, weights = weighted_moments(
            dataset, frames, design, options.weights, modelled, options.device
        )
    guess = _guess(dataset, options)
    held = _hold(solved(moments, watcher), options, guess)
    walls = None
    if options.planes == "unknown":
        walls = _find_walls(dataset, frames, held.core)
        dataset, resumed = walls.put_into(dataset), held.core.solution.parameters
        held = _hold(solved(walls.walls.seen_by(moments), watcher), options, guess, walls.walls)
    core = held.core
    moments, solution = core.moments, core.solution
    poses = torch.from_numpy(
        np.unique(dataset.pose_groups()[np.asarray(frames)], return_inverse=True)[1]
    )
    covariance = jackknife_covariance(
        moments, solution.parameters, held.belief, poses, None if walls is None else walls.walls
    )
    geometry = moments.columns([])
    bare = start_parameters(geometry, dataset, options.hand_eye)
    model, outcome = complete(core, dataset, frames, domain, options.residual, options.device)
    if outcome is not None:
        solution = replace(solution, parameters=outcome.parameters)
    return Fit(
        model=model,
        domain=domain,
        solution=solution,
        hand_eye_only=solve(geometry, bare, options.solver).parameters,
        covariance=covariance,
        moments=moments,
        observability=held.found,
        prior=held.prior,
        belief=held.belief,
        poses=poses,
        options=core.options,
        residual=outcome,
        weights=weights,
        walls=walls,
    )


class _Held(NamedTuple):
    """A fitted core, and what holds the directions that its images leave free."""

    core: Core
    found: Observability
    prior: Prior | None
    belief: Prior | None


def _guess(dataset: Dataset, options: FitOptions) -> Callable[[ImageMoments], Parameters]:
    """Return what is believed where the images tell nothing: the recorded guess, no error."""
    free = hand_eye_is_free(dataset, options.hand_eye)
    recorded = recorded_hand_eye(dataset)
    return lambda moments: Parameters(
        recorded, torch.zeros(moments.num_coefficients, dtype=torch.float64), free
    )


def _hold(
    core: Core,
    options: FitOptions,
    guess: Callable[[ImageMoments], Parameters],
    walls: Walls | None = None,
) -> _Held:
    """Look for free directions, and hold or refuse them."""
    moments, best, belief = core.moments, core.solution.parameters, core.smoothness
    if belief is not None:
        belief = belief.rescaled(effective_variance(moments, best))
    found = observability(moments, best, belief=belief, walls=walls)
    prior = prior_on_free_directions(found, guess(moments))
    if prior is None:
        return _Held(core, found, None, belief)
    if options.free_directions == "refuse":
        raise CalibrationDataError(
            f"The images leave free: {'; '.join(prior.names)}. Add tilted views on two axes and a "
            "wider range of distances, hold the hand-eye (hand_eye.estimate: no), or set "
            "free_directions: prior."
        )
    belief = prior if belief is None else prior.joined(belief)
    solution = solve(moments, core.start, options.solver, None, belief)
    return _Held(replace(core, solution=solution), found, prior, belief)


@dataclass(frozen=True)
class FoundWalls:
    """Walls that were estimated, and how to put them into a data set.

    Attributes:
        named: Which wall each frame of the data set shows.
        walls: The walls found.
        numbers: Their numbers in `named`, shape (G,).
    """

    named: WallNames
    walls: Walls
    numbers: np.ndarray

    @property
    def names(self) -> list[str]:
        """The names of the walls found."""
        return [self.named.names[number] for number in self.numbers]

    def put_into(self, dataset: Dataset) -> Dataset:
        """Return the data set with the walls found in place of those recorded."""
        return with_walls(dataset, self.named, self.walls, self.numbers)


def _find_walls(dataset: Dataset, frames: Sequence[int] | np.ndarray, core: Core) -> FoundWalls:
    """Estimate the walls of some frames together with the unknowns of a fitted core."""
    named = name_walls(dataset)
    walls, numbers = recorded_walls(dataset, frames, named)
    best = core.solution.parameters
    belief = None if core.smoothness is None else core.smoothness.equations(best)
    _, walls = estimate_walls(core.moments, best, walls, belief)
    return FoundWalls(named, walls, numbers)


def complete(
    core: Core,
    dataset: Dataset,
    frames: Sequence[int] | np.ndarray,
    domain: Domain,
    residual: ResidualOptions | None,
    device: str = "cpu",
) -> tuple[CalibrationModel, ResidualOutcome | None]:
    """Add to a fitted core what does not go through moments: fixed pattern, residual network.

    Args:
        core: The fitted core.
        dataset: The recordings.
        frames: Global numbers of the frames that it was fitted to.
        domain: The ranges that scale the model's variables.
        residual: How to train the network; None: there is to be none.
        device: Where the passes over the pixels run.
    """
    error = core.error_model(domain)
    model = calibrated(error, core.solution.parameters)
    if error.fixed_pattern is not None:
        spread = error.fixed_pattern.options.spread_mm  # type: ignore[attr-defined]
        known = None if spread == "auto" else spread * 1e-3
        offset, _ = fixed_pattern(dataset, frames, model, known, device)
        error.fixed_pattern.offset.copy_(offset)
    if residual is None:
        return model, None
    frames = np.sort(np.asarray(frames))
    outcome = fit_residual(
        FittedCore(error, core.moments, core.solution.parameters, core.smoothness),
        sample_for_residual(dataset, frames, residual.pixels, residual.network.seed),
        dataset.pose_groups()[frames],
        domain,
        residual,
    )
    error.residual = outcome.network
    error.set_coefficient_vector(outcome.parameters.coefficients)
    return calibrated(error, outcome.parameters), outcome


def calibrated(error: ErrorModel, parameters: Parameters) -> CalibrationModel:
    """Join an error model, its coefficients set, and the hand-eye transform of the parameters."""
    hand_eye = HandEye(fixed=not parameters.hand_eye_is_free)
    hand_eye.rebase(parameters.tool_from_camera)
    return CalibrationModel(error, hand_eye)
