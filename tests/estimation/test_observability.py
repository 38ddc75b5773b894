"""The report names what a recording does not determine."""

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from optional import present
from simulated_walls import fitted, simulated_wall, true_hand_eye

import tofcorr
from tofcorr.errors import CalibrationDataError
from tofcorr.estimation.moments import MomentObjective
from tofcorr.estimation.uncertainty import PRIOR_SIGMA, Direction, effective_variance, observability
from tofcorr.fit.problem import Fit
from tofcorr.pixels.dataset import Dataset
from tofcorr.training.judgement import judge
from tofcorr.training.support import Support, shortcomings

FitOf = Callable[[str], Fit]
NO_ERRORS = {
    "after": {"train": {"rms": 1.0}, "test": {"rms": 1.0}},
    "hand_eye_only": {"test": {"rms": 2.0}},
}


@pytest.fixture(scope="module")
def walls(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Dataset]:
    folder = tmp_path_factory.mktemp("walls")
    kinds: dict[str, dict[str, Any]] = {
        "good": {},
        "no tilt": {"robot": {"tilt_axes": "none"}},
        "one axis": {"robot": {"tilt_axes": "x", "roll_deg": 0.0}},
        "one axis and roll": {"robot": {"tilt_axes": "x"}},
        "white": {"shots": (("white", 30),)},
        "narrow": {"robot": {"distance_m": (1.0, 1.1)}},
    }
    return {name: simulated_wall(folder / name, **parts) for name, parts in kinds.items()}


@pytest.fixture(scope="module")
def fits(walls: dict[str, Dataset]) -> FitOf:
    """The fit to a wall by its name, made once."""
    return cache(lambda name: fitted(walls[name]))


@pytest.fixture(scope="module")
def warned(walls: dict[str, Dataset], fits: FitOf) -> Callable[[str], str]:
    """What a training on a wall warns of."""

    def warnings(name: str) -> str:
        wall, fit = walls[name], fits(name)
        best = fit.solution.parameters.tool_from_camera
        support = Support(wall, np.arange(wall.num_frames), best)
        return "\n".join(judge(fit, NO_ERRORS, support, tofcorr.inspect(wall.first))[2])

    return warnings


@pytest.mark.parametrize(
    ("names", "words"),
    [
        (("t_z",), "t_z"),
        (("t_z", "c0"), "t_z and c0 together (corr +1.00)"),
        (("t_z", "c0", "c1"), "t_z, c0 and c1 together (corr of the first two +1.00)"),
    ],
)
def test_the_name_of_a_direction_fits_into_a_sentence(names: tuple[str, ...], words: str) -> None:
    """A verdict read "t_z against c0 (corr +1.00), with c1 is known to 27 only"."""
    shares, correlation = dict.fromkeys(names, 0.5), 1.0 if len(names) > 1 else None
    direction = Direction(0.027, shares, correlation, is_undetermined=False)
    assert direction.in_words() == words


@pytest.mark.parametrize(("left", "said"), [(1.02, "gains nothing"), (1.2, "makes them worse")])
def test_only_a_correction_that_clearly_does_harm_is_advised_against(
    walls: dict[str, Dataset], fits: FitOf, left: float, said: str
) -> None:
    # A perfect camera's run was good, and warned "do not use it" for 0.2 % more error.
    after = {"train": {"rms": 1.0}, "test": {"rms": left}}
    errors = {"after": after, "hand_eye_only": {"test": {"rms": 1.0}}}
    fit, wall = fits("good"), walls["good"]
    support = Support(wall, np.arange(3), fit.solution.parameters.tool_from_camera)
    found = judge(fit, errors, support, tofcorr.inspect(wall.first))
    assert said in found[2][0]
    assert (found[0] == "do not use") == (left > 1.1)


def test_without_tilt_four_directions_stay_open(fits: FitOf, warned: Callable[[str], str]) -> None:
    undetermined = fits("no tilt").observability.undetermined
    alone = {next(iter(one.shares)) for one in undetermined if one.correlation is None}
    assert alone == {"t_x", "t_y", "w_z"}
    (paired,) = [set(one.shares) for one in undetermined if one.correlation is not None]
    assert paired == {"t_z", "c0"}
    assert "hardly tilted" in warned("no tilt")


def test_one_axis_of_tilt_without_roll_leaves_a_translation_open(
    fits: FitOf, warned: Callable[[str], str]
) -> None:
    (direction,) = fits("one axis").observability.undetermined
    assert set(direction.shares) <= {"t_x", "t_y"}
    assert "one axis only" in warned("one axis")
    assert "hardly rolled" in warned("one axis")
    assert not fits("one axis and roll").observability.undetermined


def test_a_narrow_range_of_distances_is_named_and_confounds_the_constant(
    fits: FitOf, warned: Callable[[str], str]
) -> None:
    weakest = fits("narrow").observability.directions[0]
    assert {*list(weakest.shares)[:2]} == {"t_z", "c0"}
    assert abs(present(weakest.correlation)) > 0.98
    assert "range of distances is narrow" in warned("narrow")


def test_one_reflectivity_is_named_only_if_the_model_has_an_intensity(
    walls: dict[str, Dataset], warned: Callable[[str], str]
) -> None:
    assert warned("good") == ""
    assert "one reflectivity" in warned("white")
    dataset = walls["white"]
    support = Support(dataset, np.arange(dataset.num_frames), true_hand_eye(dataset))
    assert not list(shortcomings(support, moves=True, with_intensity=False))


def test_undetermined_directions_keep_the_prior_and_it_moves_no_other(fits: FitOf) -> None:
    result = fits("one axis")
    assert result.solution.converged
    spread = result.covariance.matrix
    along = present(result.prior).factor * PRIOR_SIGMA
    assert float(along @ spread @ along.T) == pytest.approx(PRIOR_SIGMA**2, rel=0.02)
    apart = torch.linalg.eigvalsh(spread)[:-1].sqrt()
    assert float(apart.max()) < 0.1 * PRIOR_SIGMA


def test_a_direction_known_only_by_jitter_stays_near_the_recorded_guess(tmp_path: Path) -> None:
    # A robot that tilts by a ten-thousandth of a radian leaves t_x and t_y metres uncertain.
    robot = {"tilt_deg": 0.006}
    dataset = simulated_wall(tmp_path / "jitter", robot=robot)
    result = fitted(dataset)
    assert len(result.observability.undetermined) >= 3
    guess = torch.from_numpy(np.array(dataset.first.tool_from_camera))
    apart = result.solution.parameters.tool_from_camera - guess
    assert float(apart[:3, 3].norm()) < 2 * PRIOR_SIGMA


def test_undetermined_directions_can_be_refused(walls: dict[str, Dataset]) -> None:
    with pytest.raises(CalibrationDataError, match=r"do not determine: .*t_.*tilt"):
        fitted(walls["one axis"], free_directions="refuse")


def test_sigma_of_a_direction_is_its_standard_deviation_under_the_information(fits: FitOf) -> None:
    result = fits("good")
    best = result.solution.parameters
    variance = effective_variance(result.moments, best)
    precision = MomentObjective(result.moments).normal_equations(best).hessian / variance
    spread = torch.linalg.inv(precision + torch.eye(best.size).double() / PRIOR_SIGMA**2)
    found = observability(result.moments, best, None, None)
    expected = torch.linalg.eigvalsh(spread).flip(0).sqrt()
    got = torch.tensor([direction.sigma for direction in found.directions], dtype=torch.float64)
    torch.testing.assert_close(got, expected, rtol=1e-5, atol=0)
