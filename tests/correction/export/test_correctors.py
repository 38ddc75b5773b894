"""Every format corrects as the float64 model does."""

import importlib.util
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from correction.export.states import calibration

from tofcorr.correction.corrector import DepthCorrector
from tofcorr.correction.export.lut import export_lut
from tofcorr.correction.lookup import read_lut
from tofcorr.correction.state import CalibrationState


def _state(depth_kind: Any) -> CalibrationState:
    return calibration(np.eye(4), depth_kind=depth_kind)


@pytest.fixture
def frames(generator: torch.Generator) -> tuple[torch.Tensor, torch.Tensor]:
    depth = 0.4 + 2.8 * torch.rand(3, 5, 7, generator=generator)
    depth[0, 0, :2] = torch.tensor([torch.nan, 0.0])
    return depth, 5 + 1000 * torch.rand(3, 5, 7, generator=generator)


@pytest.mark.parametrize("depth_kind", ["radial", "z"])
def test_table_corrects_to_a_tenth_of_a_millimetre(
    depth_kind: str, frames: tuple[torch.Tensor, torch.Tensor], tmp_path: Path
) -> None:
    state = _state(depth_kind)
    export_lut(DepthCorrector.from_state(state), tmp_path / "corrector.npz", state)
    corrected, valid = read_lut(tmp_path / "corrector.npz")(*(f.numpy() for f in frames))
    expected, expected_valid = state.corrected(*frames)
    np.testing.assert_allclose(corrected, expected.numpy(), rtol=0, atol=1e-4)
    assert (valid == expected_valid.numpy()).all()


@pytest.mark.skipif(
    any(importlib.util.find_spec(name) is None for name in ("onnx", "onnxscript", "onnxruntime")),
    reason="the extra tofcorr[onnx] is not installed",
)
@pytest.mark.filterwarnings("ignore")  # The exporter's own dependencies warn of each other.
def test_onnx_corrects_as_the_model(
    frames: tuple[torch.Tensor, torch.Tensor], tmp_path: Path
) -> None:
    from tofcorr.correction.export.onnx import export_onnx, load_onnx

    state = _state("radial")
    export_onnx(DepthCorrector.from_state(state), tmp_path / "corrector.onnx", state)
    corrected, valid = load_onnx(tmp_path / "corrector.onnx")(*frames)
    expected, expected_valid = state.corrected(*frames)
    torch.testing.assert_close(corrected.double(), expected, rtol=0, atol=1e-6, equal_nan=True)
    assert torch.equal(valid, expected_valid)


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("g++") is None, reason="AOTInductor needs g++")
@pytest.mark.filterwarnings("ignore")  # The compiler's own dependencies warn of each other.
def test_compiled_package_corrects_as_the_model(
    frames: tuple[torch.Tensor, torch.Tensor], tmp_path: Path
) -> None:
    from tofcorr.correction.export.pt2 import export_pt2, load_pt2

    state = _state("radial")
    export_pt2(DepthCorrector.from_state(state), tmp_path / "corrector.pt2", state)
    compiled = load_pt2(tmp_path / "corrector.pt2")
    corrected, valid = compiled(*frames)
    expected, expected_valid = state.corrected(*frames)
    torch.testing.assert_close(corrected.double(), expected, rtol=0, atol=1e-6, equal_nan=True)
    assert torch.equal(valid, expected_valid)
    # The compiled code reads beside a frame of another size, and takes other numbers for its own.
    with pytest.raises(ValueError, match="the size of the calibrated camera"):
        compiled(*(image[..., :-1, :] for image in frames))
    with pytest.raises(ValueError, match="expected float32, got float64"):
        compiled(frames[0].double(), frames[1])
