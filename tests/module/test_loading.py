"""`tofcorr.load_corrector`: every file corrects alike, and none runs unless it is trusted."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from correction.export.states import calibration, write
from correction.export.test_correctors import WITHOUT_ONNX
from small_recordings import CAMERA
from torch import Tensor

import tofcorr
from tofcorr.correction.state import save_calibration, with_calibration
from tofcorr.errors import CalibrationDataError, ConfigError, FrameError

Frames = tuple[Tensor, Tensor]
WARM = [{"kind": "distance_polynomial"}, {"kind": "integration_time"}]


@pytest.fixture
def frames() -> Frames:
    """Frames in and around the calibrated ranges, two pixels without a return."""
    generator = torch.Generator().manual_seed(5)
    depth = 0.4 + 2.8 * torch.rand(3, 5, 7, generator=generator)
    depth[0, 0, :2] = torch.tensor([torch.nan, 0.0])
    return depth, 5 + 1000 * torch.rand(3, 5, 7, generator=generator)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One calibration as every file but the compiled one."""
    place, state = tmp_path_factory.mktemp("run"), calibration()
    save_calibration(place / "state.pt", state)
    tofcorr.DepthCorrection.load(place / "state.pt").save(place / "module.pt")
    (place / "alone").mkdir()
    write("torchscript", state, place / "alone" / "corrector.ts")
    write("lut", state, place / "corrector.npz")
    return place


@pytest.mark.parametrize("name", ["", "state.pt", "module.pt", "alone/corrector.ts"])
@pytest.mark.parametrize("trust", [False, True])
def test_what_holds_the_calibration_corrects_bit_for_bit(
    name: str, trust: bool, folder: Path, frames: Frames
) -> None:
    corrector = tofcorr.load_corrector(folder / name, trust=trust)
    expected = torch.jit.load(str(folder / "alone" / "corrector.ts"))
    for own, theirs in zip(corrector(*frames), expected(*frames), strict=True):
        assert torch.equal(own.nan_to_num(-1), theirs.nan_to_num(-1))
    arrays = corrector(*(one.numpy() for one in frames))
    np.testing.assert_array_equal(arrays[0], expected(*frames)[0].numpy())
    assert json.loads(corrector.metadata()) == json.loads(expected.metadata())
    assert not corrector.training


def test_a_program_is_rebuilt_from_what_it_holds_and_runs_only_if_trusted(
    tmp_path: Path, folder: Path, frames: Frames, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected, _ = tofcorr.load_corrector(folder)(*frames)
    # Where this torch has no TorchScript, a file of it still corrects.
    for name in ("script", "load"):
        monkeypatch.delattr(torch.jit, name)
    found, _ = tofcorr.load_corrector(folder / "alone" / "corrector.ts")(*frames)
    assert torch.equal(found.nan_to_num(-1), expected.nan_to_num(-1))
    with pytest.raises(ConfigError, match=r"has no TorchScript\. Export pt2, onnx or lut"):
        tofcorr.load_corrector(folder / "alone" / "corrector.ts", trust=True)
    with pytest.raises(ConfigError, match=r"has no TorchScript\. Export pt2, onnx or lut"):
        write("torchscript", calibration(), tmp_path / "corrector.ts")
    assert not any(tmp_path.iterdir())
    found, _ = tofcorr.load_corrector(folder / "corrector.npz")(*frames)
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-4, equal_nan=True)


def test_a_package_without_a_calibration_is_not_run(tmp_path: Path, frames: Frames) -> None:
    import io
    import zipfile

    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        archive.writestr("package/data/aotinductor/model/code.so", b"no code at all")
    (tmp_path / "foreign.pt2").write_bytes(content.getvalue())
    with pytest.raises(CalibrationDataError, match="holds a program and no calibration"):
        tofcorr.load_corrector(tmp_path / "foreign.pt2")
    state = calibration()
    (tmp_path / "own.pt2").write_bytes(with_calibration(content, state))
    corrected, valid = tofcorr.load_corrector(tmp_path / "own.pt2")(*frames)
    expected, expected_valid = state.corrected(*frames)
    torch.testing.assert_close(corrected.double(), expected, rtol=0, atol=1e-6, equal_nan=True)
    assert torch.equal(valid, expected_valid)


def test_conditions_hold_for_the_call_alone_and_amplitudes_where_they_are_read(
    tmp_path: Path, frames: Frames
) -> None:
    save_calibration(tmp_path / "state.pt", calibration(terms=WARM))
    corrector = tofcorr.load_corrector(tmp_path)
    usual, _ = corrector(frames[0])
    other, _ = corrector(*frames, integration_time_us=2.5e6)
    module = tofcorr.DepthCorrection.load(tmp_path)
    expected = module(frames[0], integration_time_us=2.5e6)
    torch.testing.assert_close(other, expected, rtol=0, atol=1e-6, equal_nan=True)
    assert not torch.equal(other.nan_to_num(), usual.nan_to_num())
    assert torch.equal(corrector(frames[0])[0].nan_to_num(), usual.nan_to_num())
    write("lut", calibration(terms=WARM), tmp_path / "table.npz")
    with pytest.raises(FrameError, match="integration_time_us: this file cannot take it"):
        tofcorr.load_corrector(tmp_path / "table.npz")(frames[0], integration_time_us=1.0)


REFUSED: dict[str, tuple[Callable[[Tensor, Tensor], Any], str]] = {
    "cropped": (lambda d, a: (d[:, :4], a[:, :4]), r"expected shape \(5, 7\)"),
    "float64": (lambda d, a: (d.double(), a), "expected float32, got float64 and float32"),
    "no amplitude": (lambda d, a: (d,), "amplitude: the model has a term of the amplitude"),
}


@pytest.mark.parametrize("name", ["state.pt", "corrector.npz"])
@pytest.mark.parametrize("what", REFUSED)
def test_every_format_refuses_alike(what: str, name: str, folder: Path, frames: Frames) -> None:
    change, message = REFUSED[what]
    with pytest.raises(ValueError, match=message):
        tofcorr.load_corrector(folder / name)(*change(*frames))


@pytest.mark.skipif(WITHOUT_ONNX, reason="the extra tofcorr[onnx] is not installed")
def test_an_onnx_file_corrects_as_the_run_does(
    tmp_path: Path, folder: Path, frames: Frames
) -> None:
    write("onnx", calibration(), tmp_path / "model.onnx")
    found, expected = (tofcorr.load_corrector(one) for one in (tmp_path / "model.onnx", folder))
    for given in (frames, tuple(one[0] for one in frames)):
        depth, valid = found(*given)
        torch.testing.assert_close(depth, expected(*given)[0], rtol=0, atol=1e-6, equal_nan=True)
        assert torch.equal(valid, expected(*given)[1])
    assert isinstance(found(*(one.numpy() for one in frames))[0], np.ndarray)


@pytest.mark.skipif(WITHOUT_ONNX, reason="the extra tofcorr[onnx] is not installed")
def test_a_damaged_onnx_file_is_refused_in_words(tmp_path: Path) -> None:
    (tmp_path / "model.onnx").write_bytes(b"no model at all")
    with pytest.raises(CalibrationDataError, match=r"model\.onnx: is not an ONNX file"):
        tofcorr.load_corrector(tmp_path / "model.onnx")


def test_what_is_not_to_be_used_is_not_loaded(tmp_path: Path) -> None:
    save_calibration(tmp_path / "state.pt", calibration())
    report = {"verdict": "do not use", "reason": "Too few frames."}
    (tmp_path / "report.json").write_text(json.dumps(report))
    with pytest.raises(CalibrationDataError, match="its verdict is `do not use`: Too few frames"):
        tofcorr.load_corrector(tmp_path)


def test_large_frames_are_corrected_in_strips(folder: Path, frames: Frames) -> None:
    corrector = tofcorr.load_corrector(folder)
    whole, _ = corrector(*frames)
    corrector.correct.strip_pixels = 2 * CAMERA.width
    assert torch.equal(corrector(*frames)[0].nan_to_num(), whole.nan_to_num())
