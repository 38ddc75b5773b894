"""Every format that corrects does so as the float64 model, and refuses what is no frame."""

import importlib.util
import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from correction.export.c_code.models import STATES, hard_frames
from correction.export.states import TRANSFORMS, calibration, write
from torch import Generator, Tensor

from tofcorr.correction.corrector import DepthCorrector
from tofcorr.correction.export.torchscript import export_torchscript
from tofcorr.errors import ExportError
from tofcorr.module.loading import load_corrector

Frames = tuple[Tensor, Tensor]
WITHOUT_ONNX = any(
    importlib.util.find_spec(name) is None for name in ("onnx", "onnxscript", "onnxruntime")
)


@pytest.fixture
def frames(generator: Generator) -> Frames:
    """Frames in and around the calibrated ranges, two pixels without a return."""
    depth = 0.4 + 2.8 * torch.rand(3, 5, 7, generator=generator)
    depth[0, 0, :2] = torch.tensor([torch.nan, 0.0])
    return depth, 5 + 1000 * torch.rand(3, 5, 7, generator=generator)


@pytest.mark.filterwarnings("ignore")  # The exporters' own dependencies warn of each other.
@pytest.mark.parametrize("depth_kind", ["radial", "z"])
@pytest.mark.parametrize(
    ("name", "ending", "tolerance"),
    [
        ("torchscript", "ts", 1e-6),  # float32 holds 3 m to 1.2e-7 m on either side.
        ("lut", "npz", 1e-4),
        pytest.param("onnx", "onnx", 1e-6, marks=pytest.mark.skipif(
            WITHOUT_ONNX, reason="the extra tofcorr[onnx] is not installed")),
        pytest.param("pt2", "pt2", 1e-6, marks=[pytest.mark.slow, pytest.mark.skipif(
            shutil.which("g++") is None, reason="AOTInductor needs g++")]),
    ],
)  # fmt: skip
def test_a_file_corrects_as_the_model(
    name: str, ending: str, tolerance: float, depth_kind: str, frames: Frames, tmp_path: Path
) -> None:
    state = calibration(np.eye(4), depth_kind=depth_kind)
    write(name, state, tmp_path / f"corrector.{ending}")
    corrector = load_corrector(tmp_path / f"corrector.{ending}", trust=True)
    corrected, valid = corrector(*frames)
    expected, expected_valid = state.corrected(*frames)
    assert json.loads(corrector.metadata())["depth_kind"] == depth_kind
    assert corrected.dtype == torch.float32
    torch.testing.assert_close(corrected.double(), expected, rtol=0, atol=tolerance, equal_nan=True)
    assert torch.equal(valid, expected_valid)


@pytest.mark.parametrize("depth_kind", ["radial", "z"])
@pytest.mark.parametrize("name", STATES)
def test_what_pt2_compiles_corrects_as_the_corrector(name: str, depth_kind: Any) -> None:
    # It loads torch's compiler, for seconds: only in the worker that runs this test.
    from tofcorr.correction.export.pt2 import CompilableCorrector

    state = calibration(depth_kind=depth_kind, **STATES[name])
    corrector = DepthCorrector.from_state(state)
    compiled = CompilableCorrector(corrector)
    many = corrector(*hard_frames(state, 20, seed=5))
    for depth, amplitude, *of_many in zip(*hard_frames(state, 20, seed=5), *many, strict=True):
        expected, expected_valid = corrector(depth, amplitude)
        corrected, valid = compiled(depth, amplitude)
        assert torch.equal(valid.bool(), expected_valid)
        # The largest special depth is 3e38 m, of which float32 keeps seven digits.
        torch.testing.assert_close(corrected, expected, rtol=1e-6, atol=1e-6, equal_nan=True)
        # And a frame alone is the same as in a batch.
        torch.testing.assert_close(expected, of_many[0], rtol=0, atol=0, equal_nan=True)
        assert torch.equal(expected_valid, of_many[1])


REFUSED: dict[str, tuple[Callable[[Tensor, Tensor], Frames], str]] = {
    "cropped": (lambda d, a: (d[:, :4], a[:, :4]), r"expected shape \(5, 7\)"),
    "one row": (lambda d, a: (d[0, 0], a[0, 0]), r"expected shape \(5, 7\)"),
    "other amplitude": (lambda d, a: (d, a[0]), "expected depth's shape"),
    "float64": (lambda d, a: (d.double(), a), "expected float32, got float64 and float32"),
    "gradients": (lambda d, a: (d.clone().requires_grad_(), a), "under torch.no_grad"),
    "uint16": (lambda d, a: ((1e3 * d).to(torch.uint16), a), "expected float32, got uint16 and"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_no_frame_of_the_camera_is_refused_in_words(name: str, frames: Frames) -> None:
    corrector = DepthCorrector.from_state(calibration(np.eye(4)))
    change, message = REFUSED[name]
    with pytest.raises(ValueError, match=message):
        corrector(*change(*frames))
    # TorchScript knew types by number: "expected float32, got 27 and 6".
    with pytest.raises(torch.jit.Error, match=message):
        torch.jit.script(corrector)(*change(*frames))


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("g++") is None, reason="AOTInductor needs g++")
@pytest.mark.filterwarnings("ignore")  # The compiler's own dependencies warn of each other.
def test_compiled_code_reads_no_other_frame(frames: Frames, tmp_path: Path) -> None:
    # It would read beside a frame of another size, and take other numbers for its own.
    write("pt2", calibration(np.eye(4)), tmp_path / "corrector.pt2")
    for name in ("cropped", "float64"):
        change, message = REFUSED[name]
        with pytest.raises(ValueError, match=message):
            load_corrector(tmp_path / "corrector.pt2", trust=True)(*change(*frames))


def test_points_in_the_tool_frame_are_those_of_the_camera_moved(frames: Frames) -> None:
    corrector = DepthCorrector.from_state(calibration(TRANSFORMS["general"]))
    points, in_tool = corrector.points(*frames), corrector.points_tool(*frames)
    transform = torch.from_numpy(TRANSFORMS["general"]).float()
    expected = points @ transform[:3, :3].T + transform[:3, 3]
    torch.testing.assert_close(in_tool, expected, rtol=0, atol=1e-6, equal_nan=True)
    torch.testing.assert_close(points[..., 2], corrector(*frames)[0], equal_nan=True)


@pytest.mark.parametrize("depth_kind", ["radial", "z"])
def test_a_batch_corrected_in_strips_is_the_same(depth_kind: str, frames: Frames) -> None:
    corrector = DepthCorrector.from_state(calibration(depth_kind=depth_kind))
    whole = corrector(*frames)
    corrector.strip_pixels = 30
    in_strips = torch.jit.script(corrector)(*frames)
    torch.testing.assert_close(in_strips, whole, rtol=0, atol=0, equal_nan=True)


def test_metadata_names_camera_model_and_range() -> None:
    metadata = json.loads(DepthCorrector.from_state(calibration(np.eye(4))).metadata())
    assert metadata["camera"]["width"] == 7
    assert (metadata["model"], metadata["depth_kind"]) == ("EA", "z")
    assert metadata["needs_amplitude"] is True


def test_a_corrector_loads_and_runs_where_torch_is_alone(frames: Frames, tmp_path: Path) -> None:
    state = calibration(np.eye(4))
    write("torchscript", state, tmp_path / "corrector.ts")
    for name, frame in zip(("depth", "amplitude"), frames, strict=True):
        np.save(tmp_path / f"{name}.npy", frame.numpy())
    program = (
        "import sys, numpy as np\n"
        "for name in ('tofcorr', 'kornia', 'cv2', 'scipy', 'pydantic'):\n"
        "    sys.modules[name] = None\n"
        "import torch\n"
        "d, a = (torch.from_numpy(np.load(f'{n}.npy')) for n in ('depth', 'amplitude'))\n"
        "np.save('out.npy', torch.jit.load('corrector.ts')(d, a)[0].numpy())\n"
    )
    words = [sys.executable, "-W", "ignore", "-I", "-c", program]
    subprocess.run(words, check=True, cwd=tmp_path)
    expected, _ = state.corrected(*frames)
    np.testing.assert_allclose(np.load(tmp_path / "out.npy"), expected.numpy(), atol=1e-6)


def test_export_of_another_calibration_is_refused_and_leaves_nothing(tmp_path: Path) -> None:
    state = calibration(np.eye(4))
    other = calibration(np.eye(4), coefficients=state.coefficients + 1e-4)
    with pytest.raises(ExportError, match="differs from the float64 model"):
        export_torchscript(DepthCorrector.from_state(other), tmp_path / "corrector.ts", state)
    assert list(tmp_path.iterdir()) == []
