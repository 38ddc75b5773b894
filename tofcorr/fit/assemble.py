"""The calibrated model: a fitted core, and what does not go through moments."""

from typing import NamedTuple

import numpy as np
import torch

from tofcorr.correction.hand_eye import HandEye
from tofcorr.correction.model import CalibrationModel
from tofcorr.error_terms.model import ErrorModel
from tofcorr.errors import CalibrationDataError
from tofcorr.estimation.noise import DistanceNoise
from tofcorr.estimation.parameters import Parameters
from tofcorr.fit.core import Core
from tofcorr.fit.hold import Held
from tofcorr.fit.noise_shift import NoiseShift, noise_of, without_noise_shift
from tofcorr.fit.pixel_pattern import fixed_pattern
from tofcorr.fit.problem import Problem
from tofcorr.fit.residual_fit import ResidualOutcome, fit_residual
from tofcorr.fit.residual_options import ResidualOptions
from tofcorr.fit.residual_sample import sample_for_residual
from tofcorr.fit.residual_training import FittedCore
from tofcorr.fit.weighting import PixelWeights

_ROTATION = 1e-6
"""Largest departure of a hand-eye's rotation from an orthogonal matrix, no unit. Rounding makes
1e-15 for a step of any sensible size; only one of a million turns makes so much."""


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


def with_network(
    problem: Problem, core: Core, residual: ResidualOptions
) -> tuple[CalibrationModel, ResidualOutcome]:
    """Add to a fitted core its fixed pattern, and a residual network if images gain by it.

    Returns:
        The model, and how the network was decided on.
    """
    error = with_pattern(problem, core).error
    frames = np.sort(problem.frames)
    outcome = fit_residual(
        FittedCore(error, core.moments, core.solution.parameters, core.smoothness),
        sample_for_residual(problem.dataset, frames, residual.pixels, residual.network.seed),
        problem.dataset.pose_groups()[frames],
        problem.domain,
        residual,
    )
    error.residual = outcome.network
    error.set_coefficient_vector(outcome.parameters.coefficients)
    return calibrated(error, outcome.parameters), outcome


def refuse_diverged(parameters: Parameters) -> None:
    """Refuse a hand-eye transform that the solver moved so far that it is no rotation any more.

    Raises:
        CalibrationDataError: The frames do not determine it, and its estimate grew without bounds.
    """
    rotation = parameters.tool_from_camera[:3, :3].detach()
    product = rotation @ rotation.T
    if bool(((product - torch.eye(3).to(product)).abs() < _ROTATION).all()):
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


class Completed(NamedTuple):
    """A fitted core with all that is added to it.

    Attributes:
        problem: What was fitted, on the walls that go with the core.
        core: The core, without what the noise of the distances moves.
        model: The model of the core, with fixed pattern and residual network.
        residual: How the network was decided on; None if none was asked for.
        noise: Of a measured distance; None if unknown.
        shift: What that noise moves; None if unknown.
    """

    problem: Problem
    core: Core
    model: CalibrationModel
    residual: ResidualOutcome | None
    noise: DistanceNoise | None
    shift: NoiseShift | None


def completed(problem: Problem, held: Held, weights: PixelWeights | None) -> Completed:
    """Decide on the residual network, take the noise's shift off, and add the fixed pattern."""
    noise, outcome = noise_of(problem, weights), None
    if problem.options.residual is not None:
        model, outcome = with_network(problem, held.core, problem.options.residual)
        if outcome.kept:
            _, core, shift = without_noise_shift(problem, held, weights, noise, network=True)
            return Completed(problem, core, model, outcome, noise, shift)
    problem, core, shift = without_noise_shift(problem, held, weights, noise, network=False)
    return Completed(problem, core, with_pattern(problem, core), outcome, noise, shift)
