"""What a fitted model lacks is found in what it leaves, and widens the hand-eye's interval."""

from dataclasses import dataclass, replace
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


@dataclass(frozen=True)
class Case:
    data: Dataset
    fit: Fit

    @property
    def error(self) -> torch.Tensor:
        """How far the estimate is from the truth, in the camera's axes, (3,), metres."""
        found = self.fit.solution.parameters.tool_from_camera
        return found[:3, :3].T @ (true_hand_eye(self.data) - found)[:3, 3]

    def found(self) -> Shift | None:
        return find_misfit(self.seen(), self.fit)

    def seen(self, frames: int | None = None) -> MisfitPixels:
        """Return some pixels of the first frames; None: of all."""
        found = misfit_pixels(self.data, self.fit, np.arange(frames or self.data.num_frames))
        assert found is not None
        return found


def _case(folder: Path, *effects: dict[str, object]) -> Case:
    data = simulated_wall(folder, 11, SHOTS, QUIET, effects=list(effects))
    return Case(data, fitted(data))


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Case:
    return _case(tmp_path_factory.mktemp("misfit") / "plain")


@pytest.fixture(scope="module")
def seen(plain: Case) -> MisfitPixels:
    return plain.seen()


def test_nothing_is_found_where_the_model_describes_all(plain: Case) -> None:
    assert plain.found() is None


@pytest.mark.parametrize("name", LACKING)
def test_an_error_that_the_model_lacks_is_found(tmp_path: Path, name: str) -> None:
    """Such runs were `good`, their hand-eye 15 to 28 mm off, four to nine times their interval."""
    case = _case(tmp_path / "recording", LACKING[name])
    found = case.found()
    assert found is not None
    assert found.cause == name
    # The step that it states leads to the truth, most of the way.
    assert float((case.error - found.twist[:3]).norm()) < 0.5 * float(case.error.norm())
    widened = replace(case.fit, misfit=found).hand_eye_covariance
    quantile = student_quantile(0.975, case.fit.covariance.degrees_of_freedom)
    before, after = (
        quantile * one[:3, :3].diagonal().sqrt() for one in (case.fit.hand_eye_covariance, widened)
    )
    assert bool((case.error.abs() > before).any())
    assert bool((case.error.abs() <= after).all())


def test_the_interval_holds_the_shift(plain: Case) -> None:
    """The standard error with a shift is the root of the sum of squares, along every direction."""
    twist = torch.tensor([3e-3, 0.0, 4e-3, 0.0, 1e-3, 0.0], dtype=torch.float64)
    misfit = Shift("probe", "do something", twist, 0.0)
    widened = replace(plain.fit, misfit=misfit).hand_eye_covariance
    along = torch.nn.functional.normalize(twist, dim=0)
    before = float(along @ plain.fit.hand_eye_covariance @ along)
    assert float(along @ widened @ along) == pytest.approx(before + float(twist @ twist))


def test_no_probe_repeats_another(seen: MisfitPixels) -> None:
    """Each column of each probe is finite, and no combination of the others of its probe."""
    for name, (_, columns) in (finer_forms(seen) | probes(seen)).items():
        assert bool(columns.isfinite().all()), name
        scaled = columns / columns.norm(dim=0)
        assert float(torch.linalg.svdvals(scaled)[-1]) > 1e-3, name


def test_the_jacobian_is_what_a_step_does(plain: Case, seen: MisfitPixels) -> None:
    """A small shift of the camera moves the points off their planes as the columns say."""
    parameters = plain.fit.solution.parameters
    for axis in range(6):
        step = torch.zeros(parameters.size, dtype=torch.float64)
        step[axis] = 1e-6
        solution = replace(plain.fit.solution, parameters=parameters.moved(step))
        after = Case(plain.data, replace(plain.fit, solution=solution)).seen().residual
        slope = (after - seen.residual) / 1e-6
        # A turn moves the measured point, the column that on the plane: they differ by the noise.
        torch.testing.assert_close(slope, seen.unknowns[:, axis], rtol=0.0, atol=0.05)


def test_a_turned_principal_point_is_a_turned_camera(seen: MisfitPixels) -> None:
    """In the middle of the image both move every ray alike."""
    x, y = seen.ray[:, 0] / seen.ray[:, 2], seen.ray[:, 1] / seen.ray[:, 2]
    middle = x.square() + y.square() < 0.05**2
    assert int(middle.sum()) > 10
    columns = probes(seen)["principal_point"][1][middle]
    turns = torch.stack([seen.unknowns[middle, 4], -seen.unknowns[middle, 3]], dim=1)
    torch.testing.assert_close(columns, turns, rtol=0.01, atol=0.01)


def test_the_frame_before_is_that_of_the_recording(plain: Case, seen: MisfitPixels) -> None:
    depth = plain.data.first.depth
    first = seen.frame == 0
    assert bool(seen.before[first].isnan().all())
    known = seen.before[seen.frame == 5]
    assert bool(np.isin(known[known.isfinite()].numpy(), depth[4].astype(np.float64)).all())


def test_too_few_poses_say_nothing(plain: Case) -> None:
    """Ten poses cannot tell thirty unknowns from the scatter between poses."""
    assert find_misfit(plain.seen(10), plain.fit) is None
