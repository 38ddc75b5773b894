"""What a fitted model lacks is found in what it leaves, and widens the hand-eye's interval."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from simulated_walls import QUIET, fitted, simulated_wall, true_hand_eye

from tofcorr.estimation.robust import student_quantile
from tofcorr.fit.misfit import MisfitPixels, find_misfit, finer_forms, misfit_pixels, probes
from tofcorr.fit.problem import Fit, Shift
from tofcorr.pixels.dataset import Dataset

SHOTS = (("white", 12), ("checkerboard", 16))
LACKING = {
    "incidence": {"name": "incidence_angle", "secant": 0.02},
    "focal_length": {"name": "lens", "focal_x": 0.02, "focal_y": 0.02},
    "radial": {"name": "lens", "radial_2": 0.1},
}
Case = tuple[Dataset, Fit]


def _case(folder: Path, *effects: dict[str, object]) -> Case:
    data = simulated_wall(folder, 11, SHOTS, QUIET, effects=list(effects))
    return data, fitted(data)


def _seen(case: Case, frames: int = 28) -> MisfitPixels:
    """Return some pixels of the first frames."""
    found = misfit_pixels(*case, np.arange(frames))
    assert found is not None
    return found


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Case:
    return _case(tmp_path_factory.mktemp("misfit") / "plain")


@pytest.fixture(scope="module")
def seen(plain: Case) -> MisfitPixels:
    return _seen(plain)


def test_nothing_is_found_where_the_model_describes_all(plain: Case, seen: MisfitPixels) -> None:
    assert find_misfit(seen, plain[1]) is None
    # Ten poses cannot tell thirty unknowns from the scatter between poses.
    assert find_misfit(_seen(plain, 10), plain[1]) is None


@pytest.mark.parametrize("name", LACKING)
def test_an_error_that_the_model_lacks_is_found(tmp_path: Path, name: str) -> None:
    """Such runs were `good`, their hand-eye 15 to 28 mm off, four to nine times their interval."""
    data, fit = case = _case(tmp_path / "recording", LACKING[name])
    found = find_misfit(_seen(case), fit)
    assert found is not None
    assert found.cause == name
    # How far the estimate is from the truth, in the camera's axes, (3,), metres.
    hand_eye = fit.solution.parameters.tool_from_camera
    error = hand_eye[:3, :3].T @ (true_hand_eye(data) - hand_eye)[:3, 3]
    # The step that it states leads to the truth, most of the way.
    assert float((error - found.twist[:3]).norm()) < 0.5 * float(error.norm())
    quantile = student_quantile(0.975, fit.covariance.degrees_of_freedom)
    covariances = (one.hand_eye_covariance for one in (fit, replace(fit, misfit=found)))
    before, after = (quantile * one[:3, :3].diagonal().sqrt() for one in covariances)
    assert bool((error.abs() > before).any())
    assert bool((error.abs() <= after).all())


def test_the_interval_holds_the_shift(plain: Case) -> None:
    """The standard error with a shift is the root of the sum of squares, along every direction."""
    twist = torch.tensor([3e-3, 0.0, 4e-3, 0.0, 1e-3, 0.0], dtype=torch.float64)
    misfit = Shift("probe", "do something", twist, 0.0)
    fit = plain[1]
    widened = replace(fit, misfit=misfit).hand_eye_covariance
    along = torch.nn.functional.normalize(twist, dim=0)
    before = float(along @ fit.hand_eye_covariance @ along)
    assert float(along @ widened @ along) == pytest.approx(before + float(twist @ twist))


def test_no_probe_repeats_another(seen: MisfitPixels) -> None:
    """Each column of each probe is finite, and no combination of the others of its probe."""
    for name, (_, columns) in (finer_forms(seen) | probes(seen)).items():
        assert bool(columns.isfinite().all()), name
        scaled = columns / columns.norm(dim=0)
        assert float(torch.linalg.svdvals(scaled)[-1]) > 1e-3, name


def test_a_turned_principal_point_is_a_turned_camera(seen: MisfitPixels) -> None:
    """In the middle of the image both move every ray alike."""
    away = seen.linear.ray[:, :2] / seen.linear.ray[:, 2:]
    middle = away.square().sum(1) < 0.05**2
    assert int(middle.sum()) > 10
    columns = probes(seen)["principal_point"][1][middle]
    turns = torch.stack([seen.linear.unknowns[middle, 4], -seen.linear.unknowns[middle, 3]], dim=1)
    torch.testing.assert_close(columns, turns, rtol=0.01, atol=0.01)
