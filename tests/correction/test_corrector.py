"""The runtime keeps its contract, and every export agrees with the float64 model."""

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from correction.export.states import calibration
from torch import Tensor

from tofcorr.correction.corrector import DepthCorrector
from tofcorr.correction.export.torchscript import export_torchscript
from tofcorr.correction.state import CalibrationState, load_calibration, save_calibration
from tofcorr.error_terms.model import ErrorModelOptions
from tofcorr.errors import CalibrationDataError, ExportError
from tofcorr.geometry.rays import ray_directions

D = {"kind": "distance_polynomial"}
TERMS: dict[str, list[dict[str, Any]]] = {
    "constant": [],
    "E0": [D, {"kind": "pixel_polynomial", "degree": 1}],
    "EA": [D, {"kind": "pixel_polynomial"}, {"kind": "amplitude_polynomial"}],
    "EB": [
        D,
        {"kind": "pixel_polynomial"},
        {"kind": "amplitude_polynomial", "variable": "normalised_amplitude"},
    ],
}


def _state(model: str, depth_kind: Any = "radial", **changed: Any) -> CalibrationState:
    options = ErrorModelOptions.from_mapping({"terms": TERMS[model]}, "test")
    size = {"constant": 1, "E0": 6, "EA": 10, "EB": 10}[model]
    drawn = torch.randn(size, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    transform = np.eye(4)
    transform[:3, 3] = (0.1, -0.2, 0.3)
    values = {"name": model, "error_model": options, "coefficients": 0.01 * drawn}
    return calibration(transform, **(values | {"depth_kind": depth_kind} | changed))


@pytest.fixture
def frames(generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Two frames within the calibrated ranges."""
    depth = 0.7 + 1.5 * torch.rand(2, 5, 7, generator=generator)
    amplitude = 100 + 150 * torch.rand(2, 5, 7, generator=generator)
    return depth, amplitude


@pytest.mark.parametrize("depth_kind", ["radial", "z"])
@pytest.mark.parametrize("model", TERMS)
def test_scripted_runtime_agrees_with_the_float64_model(
    model: str, depth_kind: str, frames: tuple[Tensor, Tensor], tmp_path: Path
) -> None:
    state = _state(model, depth_kind)
    export_torchscript(DepthCorrector.from_state(state), tmp_path / "corrector.ts", state)
    loaded = torch.jit.load(str(tmp_path / "corrector.ts"))
    corrected, valid = loaded(*frames)
    expected, expected_valid = state.corrected(*frames)
    # float32 holds 3 m to 1.2e-7 m on either side of the subtraction.
    torch.testing.assert_close(corrected.double(), expected, rtol=0, atol=1e-6)
    assert torch.equal(valid, expected_valid)
    assert corrected.dtype == torch.float32


def test_a_frame_alone_and_in_a_batch_are_equal(frames: tuple[Tensor, Tensor]) -> None:
    corrector = DepthCorrector.from_state(_state("EA"))
    many, many_valid = corrector(*frames)
    for k in range(2):
        one, one_valid = corrector(frames[0][k], frames[1][k])
        assert torch.equal(one, many[k])
        assert torch.equal(one_valid, many_valid[k])


@pytest.mark.parametrize("missing", [float("nan"), 0.0, -1.0, float("inf")])
def test_no_return_gives_nan_and_is_not_valid(
    missing: float, frames: tuple[Tensor, Tensor]
) -> None:
    depth, amplitude = frames
    depth[0, 1, 2] = missing
    corrected, valid = DepthCorrector.from_state(_state("EA"))(depth, amplitude)
    assert bool(corrected[0, 1, 2].isnan())
    assert not valid[0, 1, 2]
    assert int(valid.sum()) == valid.numel() - 1
    assert int(corrected.isnan().sum()) == 1


@pytest.mark.parametrize(("beyond", "edge"), [(3.4, 3.0), (0.3, 0.5)])
def test_beyond_the_range_the_error_is_that_of_its_edge_and_the_pixel_not_valid(
    beyond: float, edge: float
) -> None:
    corrector = DepthCorrector.from_state(_state("EA"))
    amplitude = torch.full((5, 7), 200.0)
    outside, valid = corrector(torch.full((5, 7), beyond), amplitude)
    at_edge, _ = corrector(torch.full((5, 7), edge), amplitude)
    torch.testing.assert_close(beyond - outside, edge - at_edge, rtol=0, atol=1e-6)
    assert not valid.any()


def test_beyond_the_range_of_amplitude_the_error_is_that_of_its_edge() -> None:
    corrector = DepthCorrector.from_state(_state("EA"))
    depth = torch.full((5, 7), 1.5)
    outside, valid = corrector(depth, torch.full((5, 7), 2000.0))
    at_edge, _ = corrector(depth, torch.full((5, 7), 900.0))
    torch.testing.assert_close(outside, at_edge, rtol=0, atol=1e-6)
    assert not valid.any()


def test_model_without_amplitude_term_takes_any_amplitude(frames: tuple[Tensor, Tensor]) -> None:
    corrector = DepthCorrector.from_state(_state("E0"))
    corrected, valid = corrector(frames[0], torch.full_like(frames[1], torch.nan))
    assert torch.equal(corrected, corrector(*frames)[0])
    assert valid.all()


def test_saturated_pixels_are_not_valid(frames: tuple[Tensor, Tensor]) -> None:
    state = _state("EA", saturation_amplitude=200.0)
    _, valid = DepthCorrector.from_state(state)(*frames)
    assert torch.equal(valid, frames[1] < 200.0)


@pytest.mark.parametrize("depth_kind", ["radial", "z"])
def test_points_lie_on_the_rays_at_the_corrected_depth(
    depth_kind: str, frames: tuple[Tensor, Tensor]
) -> None:
    corrector = DepthCorrector.from_state(_state("EA", depth_kind))
    points = corrector.points(*frames)
    rays = ray_directions(_state("EA").camera).float()
    unit = torch.nn.functional.normalize(points, dim=-1)
    torch.testing.assert_close(unit, rays.expand_as(unit), rtol=0, atol=1e-6)
    measured = points[..., 2] if depth_kind == "z" else points.norm(dim=-1)
    torch.testing.assert_close(measured, corrector(*frames)[0], rtol=0, atol=1e-6)
    in_tool = corrector.points_tool(*frames)
    shift = torch.tensor([0.1, -0.2, 0.3]).expand_as(in_tool)
    torch.testing.assert_close(in_tool - points, shift, rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d, a: (d[:, :4], a[:, :4]), r"expected shape \(5, 7\)"),
        (lambda d, a: (d[0, 0], a[0, 0]), r"expected shape \(5, 7\)"),
        (lambda d, a: (d, a[0]), "expected the shape of depth"),
        (lambda d, a: (d.double(), a), "expected float32, got float64 and float32"),
        (lambda d, a: ((1e3 * d).to(torch.uint16), a), "expected float32, got uint16 and"),
    ],
    ids=["cropped", "one row", "other amplitude", "float64", "uint16"],
)
def test_what_is_no_frame_of_the_camera_is_refused_in_words(
    change: Callable[[Tensor, Tensor], tuple[Tensor, Tensor]],
    message: str,
    frames: tuple[Tensor, Tensor],
) -> None:
    corrector = DepthCorrector.from_state(_state("EA"))
    with pytest.raises(ValueError, match=message):
        corrector(*change(*frames))
    # TorchScript knew types by number: "expected float32, got 27 and 6".
    with pytest.raises(torch.jit.Error, match=message):
        torch.jit.script(corrector)(*change(*frames))


def test_metadata_names_camera_model_and_range() -> None:
    metadata = json.loads(DepthCorrector.from_state(_state("EB")).metadata())
    assert metadata["camera"]["width"] == 7
    assert metadata["model"] == "EB"
    assert metadata["depth_kind"] == "radial"
    assert metadata["needs_amplitude"] is True


def test_corrector_loads_and_runs_where_there_is_torch_alone(
    frames: tuple[Tensor, Tensor], tmp_path: Path
) -> None:
    state = _state("EA")
    export_torchscript(DepthCorrector.from_state(state), tmp_path / "corrector.ts", state)
    for name, frame in zip(("depth", "amplitude"), frames, strict=True):
        np.save(tmp_path / f"{name}.npy", frame.numpy())
    program = (
        "import sys, numpy as np\n"
        "for name in ('tofcorr', 'kornia', 'cv2', 'scipy', 'pydantic'):\n"
        "    sys.modules[name] = None\n"
        "import torch\n"
        f"c = torch.jit.load({str(tmp_path / 'corrector.ts')!r})\n"
        f"d, a = (torch.from_numpy(np.load({str(tmp_path)!r} + f'/{{n}}.npy'))"
        " for n in ('depth', 'amplitude'))\n"
        f"np.save({str(tmp_path / 'out.npy')!r}, c(d, a)[0].numpy())\n"
    )
    subprocess.run([sys.executable, "-W", "ignore", "-I", "-c", program], check=True)
    expected, _ = state.corrected(*frames)
    np.testing.assert_allclose(np.load(tmp_path / "out.npy"), expected.numpy(), atol=1e-6)


def test_export_of_another_calibration_is_refused_and_leaves_nothing(tmp_path: Path) -> None:
    state = _state("EA")
    other = _state("EA", coefficients=state.coefficients + 1e-4)
    with pytest.raises(ExportError, match=r"differs|disagree"):
        export_torchscript(DepthCorrector.from_state(other), tmp_path / "corrector.ts", state)
    assert list(tmp_path.iterdir()) == []


def test_calibration_survives_its_file(tmp_path: Path, frames: tuple[Tensor, Tensor]) -> None:
    state = _state("EB", "z", saturation_amplitude=800.0)
    save_calibration(tmp_path / "state.pt", state)
    found = load_calibration(tmp_path / "state.pt")
    assert torch.equal(found.coefficients, state.coefficients)
    assert found.camera == state.camera
    assert found.domain == state.domain
    expected, _ = state.corrected(*frames)
    assert torch.equal(found.corrected(*frames)[0], expected)


def test_a_file_that_is_no_calibration_is_refused(tmp_path: Path) -> None:
    (tmp_path / "state.pt").write_bytes(b"not a calibration")
    with pytest.raises(CalibrationDataError, match="is not a calibration"):
        load_calibration(tmp_path / "state.pt")
