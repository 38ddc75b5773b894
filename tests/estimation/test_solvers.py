"""The solver finds the optimum, and says so only if it did."""

import math

import numpy as np
import pytest
import torch
from cameras import apart
from scipy.optimize import least_squares
from synthetic_scene import E0, EA, EB, Scene, make_scene, nearby, without_invalid_pixels
from torch import Generator

from tofcorr.estimation.linear import NormalEquations
from tofcorr.estimation.moments import MomentObjective, Parameters
from tofcorr.estimation.solvers import Solution, SolverOptions, initial_parameters, minimise


@pytest.fixture
def scene(generator: Generator) -> Scene:
    return make_scene(generator, EA)


@pytest.fixture
def objective(scene: Scene) -> MomentObjective:
    return MomentObjective(scene.moments())


@pytest.mark.parametrize("terms", [E0, EA, EB], ids=["E0", "EA", "EB"])
def test_the_optimum_is_that_of_scipy_over_the_pixels_from_far_and_near(
    terms: dict, generator: Generator
) -> None:
    scene = make_scene(generator, terms)
    whole, used = without_invalid_pixels(scene), scene.batch.valid
    start = nearby(scene.truth, generator, 0.005)

    def residual(step: np.ndarray) -> np.ndarray:
        with torch.no_grad():
            return whole.residual_of_step(start, torch.from_numpy(step))[used].numpy()

    exact = dict.fromkeys(("xtol", "ftol", "gtol"), 1e-14)
    theirs = least_squares(residual, np.zeros(start.size), method="lm", **exact)
    true = start.moved(torch.from_numpy(theirs.x)).tool_from_camera
    for from_where in (start, nearby(scene.truth, generator, 0.1)):
        ours = minimise(MomentObjective(scene.moments()), from_where)
        assert ours.loss == pytest.approx(2 * theirs.cost, rel=1e-9)
        # SciPy's finite differences end at about 1e-8 of a metre or radian.
        assert (apart(ours.parameters.tool_from_camera, true) < (1e-3, 1e-4)).all()


def test_data_without_noise_give_the_truth_back(generator: Generator) -> None:
    scene = make_scene(generator, EA, noise=0.0)
    objective = MomentObjective(scene.moments())
    solution = minimise(objective, initial_parameters(objective.moments))
    assert solution.converged
    # Ten micrometres are the least residual believed; a millionth of a standard error is left.
    off = apart(solution.parameters.tool_from_camera, scene.truth.tool_from_camera)
    assert (off < (1e-7, 1e-8)).all()
    found = solution.parameters.coefficients
    torch.testing.assert_close(found, scene.truth.coefficients, rtol=0.0, atol=1e-9)


def test_an_iteration_limit_is_not_convergence(
    scene: Scene, objective: MomentObjective, generator: Generator
) -> None:
    start = nearby(scene.truth, generator, 0.05)
    solution = minimise(objective, start, SolverOptions(max_iterations=1))
    assert solution.stopped == "iteration_limit"
    assert not solution.converged
    assert solution.iterations == 1
    assert solution.loss < float(objective.loss(start))


def test_a_watcher_sees_every_iteration_and_can_interrupt(
    scene: Scene, objective: MomentObjective, generator: Generator
) -> None:
    start = nearby(scene.truth, generator, 0.05)
    seen: list[Solution] = []

    def watch(iteration: Solution) -> bool:
        seen.append(iteration)
        return iteration.iterations < 2

    solution = minimise(objective, start, watcher=watch)
    assert solution.stopped == "interrupted"
    assert [iteration.iterations for iteration in seen] == [0, 1, 2]
    assert [iteration.loss for iteration in seen] == pytest.approx([*solution.history])
    assert torch.equal(seen[0].parameters.tool_from_camera, start.tool_from_camera)
    assert torch.equal(seen[-1].parameters.tool_from_camera, solution.parameters.tool_from_camera)


def test_a_fixed_hand_eye_stays_where_it_is(scene: Scene, objective: MomentObjective) -> None:
    zero = torch.zeros_like(scene.truth.coefficients)
    start = Parameters(scene.truth.tool_from_camera, zero, hand_eye_is_free=False)
    solution = minimise(objective, start)
    assert solution.converged
    assert torch.equal(solution.parameters.tool_from_camera, start.tool_from_camera)
    # What is left is linear: the normal equations are zero at the optimum.
    equations = objective.normal_equations(solution.parameters)
    step = torch.linalg.solve(equations.hessian, equations.gradient)
    assert float(step.abs().max()) < 1e-9


def test_without_unknowns_the_start_is_the_optimum(scene: Scene) -> None:
    objective = MomentObjective(scene.moments().columns([]))
    start = Parameters(scene.truth.tool_from_camera, torch.zeros(0).double(), False)
    solution = minimise(objective, start)
    assert solution.converged
    assert solution.loss == pytest.approx(float(objective.loss(start)))


class Breaking(MomentObjective):
    """An objective that turns to NaN after some evaluations."""

    def __init__(self, scene: Scene, good_evaluations: int) -> None:
        super().__init__(scene.moments())
        self._left = good_evaluations

    def normal_equations(self, parameters: Parameters) -> NormalEquations:
        self._left -= 1
        found = super().normal_equations(parameters)
        return found if self._left >= 0 else found._replace(loss=found.loss * math.nan)


@pytest.mark.parametrize("good_evaluations", [1, 2, 3])
def test_when_the_loss_turns_to_nan_the_last_good_point_is_kept(
    good_evaluations: int, scene: Scene, objective: MomentObjective, generator: Generator
) -> None:
    start = nearby(scene.truth, generator, 0.05)
    solution = minimise(Breaking(scene, good_evaluations), start)
    assert solution.stopped == "not_finite"
    assert math.isfinite(solution.loss)
    assert solution.parameters.coefficients.isfinite().all()
    assert float(objective.loss(solution.parameters)) == pytest.approx(solution.loss, rel=1e-9)
    assert solution.loss <= float(objective.loss(start)) * (1 + 1e-12)


def test_a_loss_that_is_nan_from_the_start_is_told(scene: Scene) -> None:
    solution = minimise(Breaking(scene, 0), scene.truth)
    assert solution.stopped == "not_finite"
    assert torch.equal(solution.parameters.tool_from_camera, scene.truth.tool_from_camera)
