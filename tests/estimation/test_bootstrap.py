"""Resampled recordings are fitted as if each had been fitted by itself."""

import pytest
import torch
from simulated_walls import fitted, simulated_wall

from tofcorr.errors import CalibrationDataError
from tofcorr.estimation.moments import MomentObjective
from tofcorr.estimation.solvers import minimise
from tofcorr.estimation.uncertainty import bootstrap, draw_block_weights
from tofcorr.fit.problem import Fit
from tofcorr.training.report import bootstrap_summary, correction_curves


@pytest.fixture(scope="module")
def fit(tmp_path_factory: pytest.TempPathFactory) -> Fit:
    return fitted(simulated_wall(tmp_path_factory.mktemp("wall") / "wall"))


@pytest.fixture(scope="module")
def fit_with_prior(tmp_path_factory: pytest.TempPathFactory) -> Fit:
    robot = {"tilt_axes": "x", "roll_deg": 0.0}
    return fitted(simulated_wall(tmp_path_factory.mktemp("wall") / "wall", robot=robot))


def weights(fit: Fit, number: int) -> torch.Tensor:
    return draw_block_weights(fit.poses, number, torch.Generator().manual_seed(0))


def test_each_resample_is_at_the_optimum_that_a_solver_finds(fit: Fit) -> None:
    best = fit.optimum
    drawn = weights(fit, 4)
    steps = bootstrap(fit.moments, best, drawn)
    spread = fit.covariance.standard_errors
    for row, step in zip(drawn, steps, strict=True):
        objective = MomentObjective(fit.moments.weighted(row))
        solved = minimise(objective, best).parameters
        moved = best.moved(step)
        apart = moved.tool_from_camera - solved.tool_from_camera
        assert float(apart.abs().max()) < 1e-3 * float(spread[:6].min())
        apart = (moved.coefficients - solved.coefficients).abs() / spread[6:]
        assert float(apart.max()) < 1e-3


def test_a_resample_keeps_the_prior(fit_with_prior: Fit) -> None:
    fit, best = fit_with_prior, fit_with_prior.optimum
    assert fit.total_prior is not None
    drawn = weights(fit, 2)
    steps = bootstrap(fit.moments, best, drawn, fit.total_prior)
    for row, step in zip(drawn, steps, strict=True):
        objective = MomentObjective(fit.moments.weighted(row), fit.total_prior)
        solved = minimise(objective, best).parameters
        apart = best.moved(step).tool_from_camera - solved.tool_from_camera
        assert float(apart.abs().max()) < 1e-5


def test_drawing_every_image_once_changes_nothing(fit: Fit) -> None:
    ones = torch.ones(1, fit.moments.num_images, dtype=torch.float64)
    step = bootstrap(fit.moments, fit.optimum, ones)[0]
    assert float((step.abs() / fit.covariance.standard_errors).max()) < 1e-4


def test_bootstrap_and_jackknife_agree_on_the_standard_errors(fit: Fit) -> None:
    drawn = bootstrap(fit.moments, fit.optimum, weights(fit, 1000))
    ratio = drawn.std(dim=0) / fit.covariance.standard_errors
    assert float(ratio.min()) > 0.6
    assert float(ratio.max()) < 1.6


def test_images_of_one_pose_are_drawn_together() -> None:
    poses = torch.tensor([0, 0, 1, 2, 2, 2])
    drawn = draw_block_weights(poses, 50, torch.Generator().manual_seed(0))
    assert torch.equal(drawn[:, 0], drawn[:, 1])
    assert torch.equal(drawn[:, 3], drawn[:, 5])
    assert torch.equal(drawn[:, [0, 2, 3]].sum(dim=1), torch.full((50,), 3.0).double())


def test_two_poses_are_too_few_for_a_bootstrap() -> None:
    with pytest.raises(CalibrationDataError, match="at least 3 poses, got 2"):
        draw_block_weights(torch.tensor([0, 0, 1]), 10, torch.Generator().manual_seed(0))


def test_the_curve_is_the_model_in_the_image_centre(fit: Fit) -> None:
    rows = correction_curves(fit)["distance"]
    error = fit.model.error
    centre = (slice(error.height // 2, error.height // 2 + 1), [15, 16])
    for row in rows[::5]:
        size = (error.height, error.width)
        distance = torch.full(size, row["radial_distance_m"], dtype=torch.float64)
        amplitude = torch.full(size, row["amplitude"], dtype=torch.float64)
        with torch.no_grad():
            middle = error(distance, amplitude)[centre].mean()
        # The centre lies between two columns; the pixel term is quadratic, so the mean is close.
        assert row["error_mm"] == pytest.approx(1e3 * float(middle), abs=0.05)
        assert row["standard_error_mm"] > 0


def test_the_summary_is_reproducible(fit: Fit) -> None:
    first, second = (bootstrap_summary(fit, torch.Generator().manual_seed(3)) for _ in range(2))
    assert first is not None
    assert first == second
