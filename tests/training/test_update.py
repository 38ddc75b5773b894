"""A calibration is carried on: what changed is said, and a camera type helps the next unit."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from optional import present
from simulated_walls import CAMERA, SENSOR, simulated_wall, true_hand_eye
from training.trained import CONFIG, FILES, Trained

import tofcorr
from tofcorr import CalibrationDataError, ConfigError, TrainingResult
from tofcorr.correction.state import STATE_FILE, load_calibration, save_calibration
from tofcorr.geometry import se3
from tofcorr.pixels.passes import frame_errors
from tofcorr.training.pool import between_units

# By 8.1 mm and about a degree.
BUMPED = {"translation_mm": (55.0, -24.0, 125.0), "rotation_deg": (1.5, -1.0, 88.5)}


@pytest.fixture(scope="module")
def updated(
    trained: Trained, tmp_path_factory: pytest.TempPathFactory
) -> Callable[..., TrainingResult]:
    """Return a function that simulates ten new frames, and updates the session's run by them."""

    def run(
        name: str, out: Path | None = None, prior: Path | None = None, **parts: Any
    ) -> TrainingResult:
        folder = tmp_path_factory.mktemp(name) / "new"
        new = simulated_wall(folder, seed=91, shots=(("white", 10),), **parts)
        given: dict[str, Any] = {"out": out, "prior": prior, "planes": "unknown"}
        return tofcorr.update(trained.folder, new.first, figures=False, **given)

    return run


def likeliest(result: TrainingResult) -> str:
    found = result.report["update"]["explanations"]
    assert sum(one["probability"] for one in found) == pytest.approx(1.0)
    return found[0]["changed"]


def test_a_bumped_mount_is_found_again_from_ten_frames_of_a_wall_that_nobody_measured(
    updated: Callable[..., TrainingResult], trained: Trained, tmp_path: Path
) -> None:
    result = updated("bumped", tmp_path / "run", hand_eye=BUMPED)
    assert likeliest(result) == "mount"
    moved, report = result.report["update"]["moved"], result.report
    assert moved["mount_mm"] == pytest.approx(8.1, abs=3 * moved["mount_se_mm"])
    assert "Only the mount moved: by" in repr(result)
    assert "Other explanations: " in result.details
    written = {path.name for path in (tmp_path / "run").iterdir()}
    assert written == FILES - {"report.html"}
    assert json.loads((tmp_path / "run" / "report.json").read_text())["update"] == report["update"]
    # The run can be carried on again, with what is known of all of it.
    state = load_calibration(tmp_path / "run" / STATE_FILE)
    joint = present(state.joint_covariance)
    torch.testing.assert_close(joint, joint.T)
    assert float(torch.linalg.eigvalsh(joint)[0]) > 0
    before = load_calibration(trained.folder / STATE_FILE)
    assert joint[6:, 6:].trace() < present(before.joint_covariance)[6:, 6:].trace()


def test_a_warmer_camera_is_told_from_a_bump(updated: Callable[..., TrainingResult]) -> None:
    delays = SENSOR["delays"] | {"constant_mm": SENSOR["delays"]["constant_mm"] + 12.0}
    result = updated("warmer", sensor=SENSOR | {"delays": delays})
    assert likeliest(result) == "temperature"
    moved = result.report["update"]["moved"]
    assert moved["reads_farther_mm"] == pytest.approx(12.0, abs=3 * moved["reads_farther_se_mm"])


def test_nothing_changed_keeps_parameters_within_their_standard_errors(
    updated: Callable[..., TrainingResult], trained: Trained
) -> None:
    result = updated("unchanged")
    assert likeliest(result) == "nothing"
    assert result.report["update"]["moved"] == {}
    transform = result.fit.solution.parameters.tool_from_camera
    off = se3.log(se3.inverse(true_hand_eye(trained.data)) @ transform)
    assert bool((off.abs() < 4 * result.fit.hand_eye_covariance.diagonal().sqrt()).all())


def test_a_run_of_before_says_what_it_lacks(
    updated: Callable[..., TrainingResult], trained: Trained, tmp_path: Path
) -> None:
    old = tmp_path / "run"
    old.mkdir()
    (old / "config.yaml").write_text((trained.folder / "config.yaml").read_text())
    state = load_calibration(trained.folder / STATE_FILE)
    lacking = {"joint_covariance": None, "residual_variance": None}
    save_calibration(old / STATE_FILE, state.model_copy(update=lacking))
    new = simulated_wall(tmp_path / "new", seed=91, shots=(("white", 10),), hand_eye=BUMPED)
    result = tofcorr.update(old, new.first, planes="unknown", figures=False)
    assert likeliest(result) == "mount"
    assert "count as independent" in result.details
    save_calibration(old / STATE_FILE, state.model_copy(update=lacking | {"covariance": None}))
    with pytest.raises(CalibrationDataError, match="no covariance of its coefficients; train on"):
        tofcorr.update(old, new.first)


def test_another_image_size_and_other_terms_are_refused(trained: Trained, tmp_path: Path) -> None:
    small = CAMERA | {"width": 30}
    new = simulated_wall(tmp_path / "new", shots=(("white", 10),), camera=small)
    with pytest.raises(CalibrationDataError, match="not the camera that was calibrated: expected"):
        tofcorr.update(trained.folder, new.first)
    of_type = tofcorr.pool([trained.folder, trained.folder], out=tmp_path / "type")
    assert repr(of_type).startswith("A camera type from 2 units: ")
    assert "c0" in of_type.details
    with pytest.raises(ConfigError, match="its model has other terms"):
        tofcorr.train(trained.recording, "e0", prior=tmp_path / "type")
    with pytest.raises(ConfigError, match="at least 2 units, got 1"):
        tofcorr.pool([trained.folder])
    with pytest.raises(CalibrationDataError, match="is not a camera type that tofcorr pool wrote"):
        tofcorr.train(trained.recording, CONFIG, prior=trained.folder / STATE_FILE)


def test_a_camera_type_makes_up_for_poses(
    updated: Callable[..., TrainingResult], trained: Trained, tmp_path: Path
) -> None:
    tofcorr.pool([trained.folder, trained.folder], out=tmp_path / "type")
    bumped = updated("typed", prior=tmp_path / "type", hand_eye=BUMPED)
    # A camera of a type that does not vary is the same camera.
    assert {one["changed"] for one in bumped.report["update"]["explanations"][:2]} == {
        "mount",
        "camera",
    }
    assert "what 2 units of its type have in common" in bumped.details
    few = simulated_wall(tmp_path / "few", seed=17, shots=(("white", 3), ("checkerboard", 2)))
    config = CONFIG | {"split": {"test_fraction": 0.0}, "figures": False, "advice": 0}
    other = simulated_wall(tmp_path / "other", seed=18)
    errors = {}
    for prior in (None, tmp_path / "type"):
        result = tofcorr.train(few.first, config, prior=prior)
        measured = frame_errors(other, {"after": result.fit.model}, "cpu", 1.0)
        errors[prior is not None] = measured["after"]["to_plane"].rms_mm(np.arange(30))
        assert ("prior" in result.report) == (prior is not None)
    assert errors[True] < errors[False] / 1.2


def drawn(generator: torch.Generator, units: int, *roots: torch.Tensor) -> torch.Tensor:
    """Draw vectors that are sums of normal ones with these roots of their covariances."""
    parts = [torch.randn(units, len(r), generator=generator).double() @ r.T for r in roots]
    return torch.stack(parts).sum(dim=0)


def test_the_scatter_between_units_is_what_their_own_uncertainty_leaves(
    generator: torch.Generator,
) -> None:
    between = torch.tensor([[3.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.5, 2.0]]).double()
    own = torch.tensor([1.0, 2.0, 0.5]).double().diag()
    means = 7 + drawn(generator, 400, between, own)
    mean, covariance = between_units(means, (own @ own.T).expand(400, 3, 3))
    # Of 400 units a variance is known to a fourteenth; that of a mean, to a twentieth.
    torch.testing.assert_close(mean, torch.full_like(mean, 7.0), rtol=0, atol=0.6)
    torch.testing.assert_close(covariance, between @ between.T, rtol=0.25, atol=0.8)
    alike = 7 + drawn(generator, 400, own)
    none = between_units(alike, (own @ own.T).expand(400, 3, 3))[1]
    assert float(none.diagonal().max()) < 0.6


def test_a_unit_that_is_hardly_known_hardly_counts(generator: torch.Generator) -> None:
    one = torch.eye(2).double()
    means, own = drawn(generator, 6, one), (0.01 * one).expand(6, 2, 2)
    before = between_units(means, own)
    unknown = (
        torch.cat([own, 1e8 * one[None]]),
        torch.cat([means, torch.full((1, 2), 1e3).double()]),
    )
    after = between_units(unknown[1], unknown[0])
    # It counts as one more unit of whatever scatter the others have.
    torch.testing.assert_close(after[0], before[0], rtol=0, atol=0.05)
    torch.testing.assert_close(after[1], before[1], rtol=0.35, atol=0.1)
