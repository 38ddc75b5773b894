"""Fits one model to some frames of a data set."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from tofcorr.correction.hand_eye import HandEye
from tofcorr.correction.model import CalibrationModel
from tofcorr.error_terms.domain import Domain
from tofcorr.error_terms.model import ErrorModel, ErrorModelOptions
from tofcorr.errors import CalibrationDataError
from tofcorr.estimation import lbfgs, levenberg_marquardt
from tofcorr.estimation.covariance import Covariance, jackknife_covariance
from tofcorr.estimation.design import Design
from tofcorr.estimation.initial_guess import initial_parameters, with_linear_part
from tofcorr.estimation.moments import ImageMoments
from tofcorr.estimation.objective import MomentObjective, Objective
from tofcorr.estimation.observability import Observability, effective_variance, observability
from tofcorr.estimation.parameters import Parameters
from tofcorr.estimation.prior import Prior, WithPrior, prior_on_free_directions
from tofcorr.estimation.solution import Solution, SolverOptions, Watcher
from tofcorr.training.dataset import Dataset
from tofcorr.training.options import HandEyeOptions, TrainingOptions

_SOLVERS = {"lbfgs": lbfgs.minimise, "levenberg_marquardt": levenberg_marquardt.minimise}


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
    """

    model: CalibrationModel
    domain: Domain
    solution: Solution
    hand_eye_only: Parameters
    covariance: Covariance
    moments: ImageMoments
    observability: Observability
    prior: Prior | None


def build_model(
    dataset: Dataset, options: ErrorModelOptions, domain: Domain
) -> tuple[ErrorModel, Design]:
    """Build an untrained error model on the camera of the data set, and its design.

    Raises:
        CalibrationDataError: The model needs amplitudes that a recording lacks.
    """
    if any(term.kind == "amplitude_polynomial" for term in options.terms):
        dataset.require_amplitude("the intensity term")
    error = ErrorModel(options, domain)
    return error, Design(error, domain, dataset.ray_directions())


def hand_eye_is_free(dataset: Dataset, options: HandEyeOptions) -> bool:
    """Whether the hand-eye transform is an unknown: only a moving tool reveals it."""
    return dataset.moves if options.estimate == "auto" else options.estimate == "yes"


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


def recorded_hand_eye(dataset: Dataset) -> Tensor:
    """Return tool_from_camera as the recording has it; the identity without a robot."""
    if not dataset.moves:
        return torch.eye(4, dtype=torch.float64)
    return torch.from_numpy(np.asarray(dataset.first.tool_from_camera, dtype=np.float64)).clone()


def solve(
    moments: ImageMoments,
    start: Parameters,
    options: SolverOptions,
    watcher: Watcher | None = None,
    prior: Prior | None = None,
) -> Solution:
    """Minimise the point-to-plane loss of the moments with the solver asked for."""
    objective: Objective = MomentObjective(moments)
    if prior is not None:
        objective = WithPrior(objective, prior)
    return _SOLVERS[options.kind](objective, start, options, watcher)


def fit(
    dataset: Dataset,
    frames: Sequence[int] | np.ndarray,
    options: TrainingOptions,
    domain: Domain,
    watcher: Watcher | None = None,
    resumed: Parameters | None = None,
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

    Raises:
        CalibrationDataError: The images leave a direction free, and the options refuse that.
    """
    error, design = build_model(dataset, options.model, domain)
    moments = dataset.moments(design, frames, device=options.device)
    start = resumed or start_parameters(moments, dataset, options.hand_eye)
    solution = solve(moments, start, options.solver, watcher)
    covariance = jackknife_covariance(moments, solution.parameters)
    found = observability(moments, solution.parameters, covariance.matrix)
    variance = effective_variance(moments, solution.parameters, covariance.matrix)
    prior = prior_on_free_directions(found, start, variance)
    if prior is not None:
        _refuse_if_asked(options, dataset, prior)
        solution = solve(moments, start, options.solver, watcher, prior)
        covariance = jackknife_covariance(moments, solution.parameters, prior)
    geometry = moments.columns([])
    bare = start_parameters(geometry, dataset, options.hand_eye)
    error.set_coefficient_vector(solution.parameters.coefficients)
    hand_eye = HandEye(fixed=not start.hand_eye_is_free)
    hand_eye.rebase(solution.parameters.tool_from_camera)
    return Fit(
        model=CalibrationModel(error, hand_eye),
        domain=domain,
        solution=solution,
        hand_eye_only=solve(geometry, bare, options.solver).parameters,
        covariance=covariance,
        moments=moments,
        observability=found,
        prior=prior,
    )


def _refuse_if_asked(options: TrainingOptions, dataset: Dataset, prior: Prior) -> None:
    if options.free_directions == "refuse":
        raise CalibrationDataError(
            f"{dataset.first.path}: the images leave free: {'; '.join(prior.names)}. Add tilted "
            "views on two axes and a wider range of distances, hold the hand-eye "
            "(hand_eye.estimate: no), or set free_directions: prior."
        )
