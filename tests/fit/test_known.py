"""Laws of what is known before a fit: nothing known, halves and wholes, other ranges, evidence."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from optional import present
from simulated_walls import EA, QUIET, SENSOR, simulated_wall

from tofcorr.error_terms.base import Interval
from tofcorr.error_terms.model import ErrorModel, Pixels
from tofcorr.estimation.moments import MomentObjective
from tofcorr.fit.fitting import prepare, solve
from tofcorr.fit.known import PriorKnowledge
from tofcorr.fit.problem import Problem
from tofcorr.options import resolve_options
from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.lattice import covered_domain, lattice_of
from tofcorr.training.calibration import TrainingOptions

OPTIONS = resolve_options(TrainingOptions, "ea")
# Square metres: of a residual. Standard errors are then tenths of a millimetre or milliradian.
VARIANCE = 1e-5


@pytest.fixture(scope="module")
def wall(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    # Little noise: a second order of what it moves is then nothing.
    robot = {"repeatability_mm": 0.02, "repeatability_mrad": 0.02}
    folder = tmp_path_factory.mktemp("known") / "wall"
    return simulated_wall(folder, sensor=SENSOR | QUIET, robot=robot)


def solved(wall: Dataset, frames: np.ndarray, known: PriorKnowledge | None) -> PriorKnowledge:
    """Fit some frames, and return what is known then, by the curvature of the loss."""
    every, seen = np.arange(wall.num_frames), lattice_of(wall, frames)
    domain = covered_domain(wall, every, lattice_of(wall, every))
    problem = Problem(wall, frames, OPTIONS, domain, seen, known=known)
    core = solve(problem, prepare(problem)[0], held=False)
    best = core.solution.parameters
    curvature = MomentObjective(core.moments, core.carried).normal_equations(best).hessian
    covariance = torch.linalg.inv(curvature / VARIANCE)
    return PriorKnowledge(
        options=EA, domain=domain, parameters=best, covariance=covariance, variance=VARIANCE
    )


def in_standard_errors(one: PriorKnowledge, other: PriorKnowledge) -> float:
    step = one.parameters.step_to(other.parameters)
    return float(step @ torch.linalg.solve(one.covariance, step)) ** 0.5


def test_a_prior_that_says_nothing_changes_nothing(wall: Dataset) -> None:
    frames = np.arange(wall.num_frames)
    alone = solved(wall, frames, None)
    guess = replace(alone.parameters, coefficients=torch.zeros_like(alone.parameters.coefficients))
    nothing = replace(alone, parameters=guess, covariance=1e6 * torch.eye(guess.size).double())
    again = solved(wall, frames, nothing)
    # The prior's share of the curvature is 1e-12 over the squares of standard errors, near 1e-6.
    assert in_standard_errors(alone, again) < 1e-4


def test_half_after_half_is_the_whole(wall: Dataset) -> None:
    frames = np.arange(wall.num_frames)
    whole = solved(wall, frames, None)
    first = solved(wall, frames[::2], None)
    both = solved(wall, frames[1::2], first)
    away = in_standard_errors(whole, first)
    assert away > 0.1
    # The curvature at the first solution is not quite that at the last one.
    assert in_standard_errors(whole, both) < away / 20
    torch.testing.assert_close(both.covariance, whole.covariance, rtol=0.05, atol=1e-9)


def test_other_ranges_predict_the_same_error_as_certainly(wall: Dataset) -> None:
    known = solved(wall, np.arange(wall.num_frames), None)
    low, high = known.domain.radial_distance
    amplitude = present(known.domain.amplitude)
    wider = replace(
        known.domain,
        radial_distance=Interval(low / 2, high + 1),
        amplitude=Interval(0.0, 2 * amplitude.high),
    )
    moved = known.towards(wider)
    assert moved.domain.radial_distance == wider.radial_distance
    one = torch.linspace(0, 1, 7).double()
    at = Pixels(low + one, amplitude.high * one, 24 * one, 31 * one, torch.zeros(7, 5).double())
    for here, there in ((known, moved), (known, known.of_coefficients().towards(wider))):
        twist = there.parameters.twist_size
        before = ErrorModel(EA, here.domain).columns_at(at).detach()
        after = ErrorModel(EA, there.domain).columns_at(at).detach()
        predicted = there.parameters.coefficients @ after
        torch.testing.assert_close(here.parameters.coefficients @ before, predicted)
        variance = before.T @ here.covariance[6:, 6:] @ before
        own = there.covariance[twist:, twist:]
        torch.testing.assert_close(variance, after.T @ own @ after, rtol=1e-6, atol=1e-12)


def test_what_is_known_of_coefficients_leaves_the_hand_eye_free(wall: Dataset) -> None:
    known = solved(wall, np.arange(wall.num_frames), None)
    prior = known.of_coefficients().prior(known.parameters)
    assert not prior.factor[:, :6].any()
    # One standard error along one direction, and anywhere with the hand-eye.
    root = torch.linalg.cholesky(known.covariance[6:, 6:])
    away = prior.centre.moved(torch.cat([torch.ones(6).double(), root[:, 0]]))
    assert prior.deviation(away).tolist() == pytest.approx([1.0] + [0.0] * (len(root) - 1))
