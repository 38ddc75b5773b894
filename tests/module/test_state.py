"""The state of a module holds all that its output depends on."""

import copy
import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from kinds_of_terms import KINDS, OTHER_DOMAIN
from module.modules import CAMERA, conditions, frames, module_of, options_of

from tofcorr.correction.state import save_calibration
from tofcorr.errors import CalibrationDataError, ExportError, StateError
from tofcorr.module.depth_correction import DepthCorrection

OTHER_CAMERA = replace(CAMERA, matrix=((8.0, 0.0, 2.9), (0.0, 8.5, 2.2), (0.0, 0.0, 1.0)))


def everything(module: DepthCorrection) -> list[torch.Tensor]:
    """Return all outputs on frames inside and outside the calibrated ranges."""
    depth, amplitude = frames((4,))
    depth[1] *= 2.0
    amplitude[2] *= 8.0
    depth[3, 0, 0] = math.nan
    given = conditions((4,))
    given["timestamp_s"][0] = 30.0
    outputs = (module.points_tool, module.valid, module.error)
    return [call(depth, amplitude, **given).detach().nan_to_num(7.0) for call in outputs]


def assert_same(first: DepthCorrection, second: DepthCorrection) -> None:
    torch.testing.assert_close(everything(first), everything(second), rtol=0, atol=0)
    assert first.labels() == second.labels()


@pytest.mark.parametrize("kind", KINDS)
def test_a_module_of_other_ranges_camera_and_depth_kind_becomes_identical(kind: str) -> None:
    module = module_of(kind, depth_kind="z", saturation_amplitude=700.0)
    other = DepthCorrection(OTHER_CAMERA, options_of(kind), ranges=OTHER_DOMAIN)
    other.load_state_dict(module.state_dict())
    assert_same(module, other)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_saved_module_is_loaded_as_it_was(kind: str, dtype: torch.dtype, tmp_path: Path) -> None:
    module = module_of(kind, depth_kind="z", saturation_amplitude=700.0, dtype=dtype)
    module.save(tmp_path / "module.pt")
    assert_same(DepthCorrection.load(tmp_path / "module.pt"), module)


@pytest.mark.parametrize("kind", KINDS)
def test_a_module_survives_the_calibration_of_a_run(kind: str, tmp_path: Path) -> None:
    module = module_of(kind, depth_kind="z", saturation_amplitude=700.0)
    save_calibration(tmp_path / "state.pt", module.to_state())
    for path in (tmp_path, tmp_path / "state.pt"):
        found = everything(DepthCorrection.load(path))
        torch.testing.assert_close(found, everything(module), rtol=0, atol=1e-14)


@pytest.mark.parametrize("kind", KINDS)
def test_the_state_of_other_terms_is_refused_and_changes_nothing(kind: str) -> None:
    module = module_of(kind)
    other = module_of("lookup_table" if kind == "pixel_polynomial" else "pixel_polynomial")
    before = everything(module)
    with pytest.raises(StateError, match="the state is of another model"):
        module.load_state_dict(other.state_dict())
    torch.testing.assert_close(everything(module), before, rtol=0, atol=0)


def test_the_state_of_another_image_size_is_refused() -> None:
    module = module_of("distance_polynomial")
    small = DepthCorrection(replace(CAMERA, height=4), options_of("distance_polynomial"))
    with pytest.raises(StateError, match=r"'image size' is \[4, 7\]"):
        module.load_state_dict(small.state_dict())


@pytest.mark.parametrize("kind", KINDS)
def test_a_state_of_another_dtype_is_cast_as_by_torch(kind: str) -> None:
    single, double = (module_of(kind, dtype=dtype) for dtype in (torch.float32, torch.float64))
    for source, target in ((single, double), (double, single)):
        other = DepthCorrection(OTHER_CAMERA, options_of(kind), ranges=OTHER_DOMAIN)
        dtype = target.error_model.constant.dtype
        other.to(dtype).load_state_dict(source.state_dict())
        depth, amplitude = frames()
        found = other(depth, amplitude, **conditions((2,)))
        assert torch.equal(
            found, copy.deepcopy(source).to(dtype)(depth, amplitude, **conditions((2,)))
        )


def test_every_value_of_a_state_is_a_tensor() -> None:
    state = module_of("fixed_pattern").state_dict()
    assert all(isinstance(value, torch.Tensor) for value in state.values())
    assert {"geometry.matrix", "geometry.distortion", "geometry.ray_directions"} <= set(state)


def test_a_module_moved_to_another_dtype_keeps_its_correction() -> None:
    module = module_of("periodic")
    depth, _ = frames(dtype=torch.float32)
    expected = module(depth).detach()
    torch.testing.assert_close(module.to(torch.float32)(depth), expected, rtol=0, atol=1e-6)


def test_what_is_no_module_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CalibrationDataError, match="there is no such file"):
        DepthCorrection.load(tmp_path / "nothing.pt")
    (tmp_path / "text.pt").write_text("no module")
    with pytest.raises(CalibrationDataError, match="is not a calibration"):
        DepthCorrection.load(tmp_path / "text.pt")
    with pytest.raises(ExportError, match="its folder does not exist"):
        module_of("periodic").save(tmp_path / "no" / "module.pt")
