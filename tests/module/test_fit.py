"""`fit` is what `tofcorr train` does, on the module's own parameters."""

import shutil
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
import torch
from module.modules import CAMERA
from optional import present
from simulated_walls import simulated_wall

from tofcorr import load_corrector
from tofcorr.data.recording import Recording
from tofcorr.errors import CalibrationDataError, ConfigError, TofcorrError
from tofcorr.module.depth_correction import DepthCorrection
from tofcorr.options import resolve_options
from tofcorr.training.calibration import TrainingOptions
from tofcorr.training.run import TrainingResult, train


@pytest.fixture(scope="module")
def wall(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    return simulated_wall(tmp_path_factory.mktemp("module") / "wall").first


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("trained") / "run"


@pytest.fixture(scope="module")
def trained(wall: Recording, run_folder: Path) -> TrainingResult:
    return train(wall, resolve_options(TrainingOptions, "ea", ["advice=0"]), out=run_folder)


def some(recording: Recording) -> tuple[torch.Tensor, torch.Tensor]:
    return torch.tensor(recording.depth[:3]), torch.tensor(present(recording.amplitude)[:3])


def test_a_fitted_module_is_the_run_of_a_training(
    wall: Recording, trained: TrainingResult, run_folder: Path
) -> None:
    module = DepthCorrection(wall.camera, terms="ea")
    report = module.fit(wall)
    run = DepthCorrection.load(run_folder)
    assert torch.equal(run(*some(wall)), module(*some(wall)))
    assert torch.equal(run.points_tool(*some(wall)), module.points_tool(*some(wall)))
    assert run.domain == module.domain
    assert repr(report) == repr(trained)
    errors = trained.report["error_mm"]
    assert report.after.rms == errors["after"]["test"]["rms"]
    assert report.hand_eye_only.mean_abs == errors["hand_eye_only"]["test"]["mean_abs"]
    assert list(report.translation_se_mm) == trained.report["hand_eye"]["translation_se_mm"]
    assert list(report.test_frames) == trained.report["frames"]["test"]
    assert list(report.warnings) == trained.report["warnings"]
    with pytest.raises(CalibrationDataError, match="load_corrector"):
        DepthCorrection.load(run_folder / "corrector.ts")
    deployed = torch.jit.load(str(run_folder / "corrector.ts"))
    corrected, valid = deployed(*some(wall))
    torch.testing.assert_close(module(*some(wall)), corrected, rtol=0, atol=1e-6, equal_nan=True)
    assert torch.equal(module.valid(*some(wall)), valid)


def test_a_run_whose_configuration_was_cut_short_is_never_another_run(
    trained: TrainingResult, run_folder: Path, tmp_path: Path
) -> None:
    # Cut between two lines of its model, it once was read as another model.
    shutil.copytree(run_folder, tmp_path / "run")
    whole = DepthCorrection.load(tmp_path / "run").options
    assert whole == trained.options
    config = tmp_path / "run" / "config.yaml"
    lines = config.read_text().splitlines(keepends=True)
    for kept in range(len(lines)):
        config.write_text("".join(lines[:kept]))
        with suppress(TofcorrError):
            assert DepthCorrection.load(tmp_path / "run").options == whole
    config.write_text("".join(lines[:-3]))  # The last term of the model is gone.
    with pytest.raises(CalibrationDataError, match=r"other terms than state\.pt"):
        DepthCorrection.load(tmp_path / "run")


def test_a_fitted_module_exports_the_noise_of_a_training(wall: Recording, tmp_path: Path) -> None:
    """The noise of a fitted module was unknown to its exports; that of a run was not."""
    module = DepthCorrection(wall.camera, terms="e0")
    module.fit(wall)
    train(wall, resolve_options(TrainingOptions, "e0", ["advice=0"]), out=tmp_path / "run")
    module.save(tmp_path / "module.pt")
    run = torch.jit.load(str(tmp_path / "run" / "corrector.ts"))
    expected = run.sigma(*some(wall))
    assert float(expected[0].nan_to_num().max()) > 1e-4
    for number, one in enumerate((module, DepthCorrection.load(tmp_path / "module.pt"))):
        one.export("torchscript", tmp_path / f"{number}.ts")
        found = torch.jit.load(str(tmp_path / f"{number}.ts")).sigma(*some(wall))
        torch.testing.assert_close(found, expected, rtol=1e-6, atol=0, equal_nan=True)


def test_a_fit_keeps_the_identity_of_parameters_and_minimises_the_loss(wall: Recording) -> None:
    module = DepthCorrection(wall.camera, terms="ea")
    before = {name: id(value) for name, value in module.named_parameters()}
    report = module.fit(wall, ["split.test_fraction=0", "remove_noise_shift=false"])
    assert {name: id(value) for name, value in module.named_parameters()} == before
    (batch,) = module.batches(wall, frames_per_batch=100)
    loss = module.point_to_plane_loss(batch)
    assert 1e3 * float(loss.detach()) ** 0.5 == pytest.approx(report.after.rms, rel=1e-9)
    assert not report.held_out
    # At a minimum of the loss no parameter has a gradient; scaled by a step of 1 mm or 1 mrad.
    gradients = torch.autograd.grad(loss, list(module.parameters()))
    assert max(float(g.abs().max()) for g in gradients) * 1e-3 < 1e-6 * float(loss.detach())


def test_a_fit_leaves_the_options_for_the_next_one(wall: Recording) -> None:
    module = DepthCorrection(wall.camera, terms="lookup")
    module.fit(wall)
    assert module.options.model.terms[0].is_open("strength")
    assert not module.terms.terms[0].is_open("strength")
    first = module(*some(wall)).detach()
    module.fit(wall)
    torch.testing.assert_close(module(*some(wall)), first, rtol=0, atol=1e-9)


def test_a_dropped_network_adds_nothing_and_exports(wall: Recording, tmp_path: Path) -> None:
    changes = ["residual.iterations=2", "residual.pixels=300", "residual.folds=2"]
    options = resolve_options(TrainingOptions, "ea_residual", changes)
    module = DepthCorrection(wall.camera, terms=options)
    report = module.fit(wall)
    dropped = any("was dropped" in text for text in report.warnings)
    network = present(module.error_model.residual)
    assert dropped == (not bool(network.weights.any()))
    module.export("torchscript", tmp_path / "corrector.ts")
    corrected, _ = torch.jit.load(str(tmp_path / "corrector.ts"))(*some(wall))
    torch.testing.assert_close(module(*some(wall)), corrected, rtol=0, atol=1e-6, equal_nan=True)


def test_ranges_may_come_from_a_recording_of_the_same_camera(wall: Recording) -> None:
    module = DepthCorrection(wall.camera, terms="periodic", ranges=wall)
    assert module.domain.modulation_frequency == wall.modulation_frequency
    report = module.fit([wall])
    assert report.after.rms < report.before.rms
    assert np.allclose(report.tool_from_camera, module.hand_eye().detach())
    with pytest.raises(CalibrationDataError, match=r"build one of recording\.camera"):
        DepthCorrection(CAMERA, terms="e0").fit(wall)
    with pytest.raises(ConfigError, match="not a known key"):
        DepthCorrection(wall.camera, terms="e0").fit(wall, ["solver.iterations=3"])


def test_a_frozen_hand_eye_was_estimated_all_the_same(wall: Recording, tmp_path: Path) -> None:
    # requires_grad_(False), usual before a module is used, took the hand-eye for unknown: its
    # export was refused with "its recording has no robot poses".
    module = DepthCorrection(wall.camera, terms="e0")
    module.fit(wall)
    module.requires_grad_(False)
    module.export("urdf", tmp_path / "camera.xacro")
    module.fit(wall)
    assert not module.hand_eye.twist.requires_grad
    module.export("urdf", tmp_path / "again.xacro")


def test_a_hand_eye_that_was_not_estimated_stays_so_through_file_and_state(
    wall: Recording, tmp_path: Path
) -> None:
    # A saved module of a camera without a robot came back as one whose hand-eye was estimated.
    module = DepthCorrection(wall.camera, terms="e0")
    module.fit(wall, ["hand_eye.estimate=no"])
    module.save(tmp_path / "module.pt")
    loaded = DepthCorrection.load(tmp_path / "module.pt")
    other = DepthCorrection(wall.camera, terms="e0")
    other.load_state_dict(module.state_dict())
    for one in (module, loaded, other):
        assert not one.hand_eye_estimated
        with pytest.raises(ConfigError, match="needs an estimated hand-eye transform"):
            one.export("urdf", tmp_path / "camera.xacro")
    assert not loaded.hand_eye.twist.requires_grad


def test_where_torch_has_no_torchscript_a_training_writes_all_else_and_says_so(
    wall: Recording,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    monkeypatch.delattr(torch.jit, "script")
    train(
        wall,
        resolve_options(TrainingOptions, "ea", ["advice=0", "figures=false"]),
        out=tmp_path / "run",
    )
    assert not (tmp_path / "run" / "corrector.ts").exists()
    assert "corrector.ts was not written" in caplog.text
    corrected, valid = load_corrector(tmp_path / "run")(*some(wall))
    assert bool(valid.any())
    assert bool(corrected[valid].isfinite().all())
