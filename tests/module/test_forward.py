"""What `DepthCorrection` computes: shapes, dtypes, missing returns, refusals, agreement."""

import math
from typing import Any

import pytest
import torch
from kinds_of_terms import DOMAIN, KINDS
from module.modules import CAMERA, conditions, frames, module_of, wall_batch, with_missing

from tofcorr.correction.corrector import DepthCorrector
from tofcorr.correction.export.parity import require_parity
from tofcorr.error_terms.registry import TERMS
from tofcorr.errors import CalibrationDataError, ConfigError, FrameError
from tofcorr.geometry.rays import ray_directions
from tofcorr.module.depth_correction import DepthCorrection
from tofcorr.options import shipped_names


@pytest.mark.parametrize("depth_kind", ["radial", "z"])
@pytest.mark.parametrize("kind", KINDS)
def test_the_runtime_agrees_with_the_module(kind: str, depth_kind: Any) -> None:
    module = module_of(kind, depth_kind=depth_kind, saturation_amplitude=950.0)
    state = module.to_state()
    corrector = DepthCorrector.from_state(state)
    require_parity(corrector, state)
    depth, amplitude = frames(dtype=torch.float32)
    corrected, valid = corrector(depth, amplitude)
    torch.testing.assert_close(module(depth, amplitude), corrected, rtol=0, atol=1e-6)
    assert torch.equal(module.valid(depth, amplitude), valid)
    points = module.points_tool(depth, amplitude)
    torch.testing.assert_close(points, corrector.points_tool(depth, amplitude), rtol=0, atol=3e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_autocast_moves_no_point(kind: str) -> None:
    # A training loop in bfloat16 moved points by 9 mm and the loss by 0.8 mm.
    module = module_of(kind, dtype=torch.float32)
    corrector = DepthCorrector.from_state(module.to_state())
    batch, given = wall_batch(module), conditions((2,))
    depth, amplitude = frames(dtype=torch.float32)

    def computed() -> list[torch.Tensor]:
        return [
            module.points_tool(depth, amplitude, **given),
            corrector.points_tool(depth, amplitude),
            module.hand_eye(),
            module.point_to_plane_loss(batch).sqrt(),
        ]

    expected = computed()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        found = computed()
    # The residual network is rounded to 1 / 256 of the metre it may err by here; metres are not.
    tolerance = 2e-2 if kind == "residual_network" else 2e-6
    torch.testing.assert_close(found, expected, rtol=0, atol=tolerance)


@pytest.mark.parametrize(
    "kind", ["integration_time", "room_temperature", "warm_up", "ambient_light"]
)
def test_conditions_agree_with_the_runtime_frame_by_frame(kind: str) -> None:
    module = module_of(kind)
    corrector = DepthCorrector.from_state(module.to_state())
    depth, _ = frames((3,), torch.float32)
    given = conditions((3,))
    given["timestamp_s"][1] = 9.0
    given["integration_time_us"][1] = 9e6
    given["room_temperature_c"][1] = 9.0
    found, valid = module(depth, **given), module.valid(depth, **given)
    for k in range(3):
        corrector.set_conditions(**{name: float(value[k]) for name, value in given.items()})
        one, one_valid = corrector(depth[k], depth[k])
        torch.testing.assert_close(found[k], one, rtol=0, atol=1e-6)
        assert torch.equal(valid[k], one_valid)
    assert valid[0].all()
    assert not valid[1].any()


@pytest.mark.parametrize("leading", [(), (1,), (2, 3)], ids=str)
def test_leading_dimensions_change_no_frame(
    module: DepthCorrection, leading: tuple[int, ...]
) -> None:
    depth, amplitude = frames(leading)
    given = conditions(leading)
    found = module(depth, amplitude, **given)
    assert found.shape == depth.shape
    flat = [depth.reshape(-1, 5, 7), amplitude.reshape(-1, 5, 7)]
    for k, one in enumerate(found.reshape(-1, 5, 7)):
        single = {name: value.reshape(-1)[k] for name, value in given.items()}
        expected = module(flat[0][k], flat[1][k], **single)
        torch.testing.assert_close(one, expected, rtol=0, atol=1e-14)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_result_has_the_dtype_of_the_depth(dtype: torch.dtype) -> None:
    module = module_of("distance_polynomial")
    depth, amplitude = frames(dtype=dtype)
    for found in (module(depth), module.error(depth), module.points_tool(depth, amplitude)):
        assert found.dtype == dtype
    in_float32 = module_of("distance_polynomial", dtype=torch.float32)
    torch.testing.assert_close(in_float32(depth), module(depth), rtol=0, atol=1e-6)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_short_types_are_corrected_like_their_values_and_rounded(dtype: torch.dtype) -> None:
    module = module_of("amplitude_polynomial")
    depth, amplitude = (frame.to(dtype) for frame in frames())
    found = module(depth, amplitude)
    assert torch.equal(found, module(depth.double(), amplitude.double()).to(dtype))
    assert module.points_tool(depth, amplitude).dtype == dtype


def test_frames_are_never_written_into() -> None:
    module = module_of("amplitude_polynomial")
    depth, amplitude = frames()
    depth = with_missing(depth)
    before = depth.clone(), amplitude.clone()
    state = {name: value.clone() for name, value in module.state_dict().items()}
    found = module(depth, amplitude)
    assert found.data_ptr() != depth.data_ptr()
    torch.testing.assert_close((depth, amplitude), before, rtol=0, atol=0, equal_nan=True)
    assert all(torch.equal(module.state_dict()[name], value) for name, value in state.items())


def test_a_missing_return_gives_nan_and_is_not_valid(module: DepthCorrection) -> None:
    depth, amplitude = frames()
    found = module(with_missing(depth), amplitude)
    expected = module(depth, amplitude)
    expected[..., 0, :5] = math.nan
    torch.testing.assert_close(found, expected, rtol=0, atol=0, equal_nan=True)
    assert torch.equal(module.valid(with_missing(depth), amplitude), expected.isfinite())


@pytest.mark.parametrize("kind", KINDS)
def test_beyond_the_ranges_the_error_is_that_of_their_edges(kind: str) -> None:
    module = module_of(kind, saturation_amplitude=5000.0)
    ranges = module.error_model.limits(module.domain)
    near, far = ranges.radial_distance
    weak, strong = module.domain.amplitude or ranges.radial_distance
    outside = torch.tensor([0.9 * near, 1.1 * far, near, near, near]).double()[:, None, None]
    strength = torch.tensor([weak, weak, 0.9 * weak, 1.1 * strong, 5000.0]).double()[:, None, None]
    frames_outside = [value.expand(5, 5, 7) for value in (outside, strength)]
    edges = outside.clamp(near, far), strength.clamp(weak, strong)
    if kind != "residual_network":  # It fades to zero outside in place of staying as it is.
        at_edge = module.error(*(value.expand(5, 5, 7) for value in edges))
        torch.testing.assert_close(module.error(*frames_outside), at_edge, rtol=0, atol=1e-12)
    needed = module.error_model.needs_amplitude()
    expected = [False, False, not needed, not needed, False]
    assert module.valid(*frames_outside)[:, 0, 0].tolist() == expected


@pytest.mark.parametrize("kind", TERMS)
def test_amplitudes_are_needed_where_a_term_says_so(kind: str) -> None:
    module = module_of(kind)
    depth, amplitude = frames()
    if TERMS[kind].needs == ("amplitude",):
        with pytest.raises(FrameError, match="the model has a term of the amplitude"):
            module(depth)
        amplitude[0, 1, 2] = math.nan
        assert module(depth, amplitude).isnan().sum() == 1
    else:
        assert torch.equal(module(depth), module(depth, amplitude))


def test_the_corrected_depth_lies_on_its_ray_less_its_error() -> None:
    for depth_kind in ("radial", "z"):
        module = module_of("distance_polynomial", depth_kind=depth_kind)
        depth, _ = frames()
        assert torch.equal(depth - module.error(depth), module(depth))
    module = module_of("distance_polynomial")
    depth, _ = frames()
    points = module.points(depth)
    torch.testing.assert_close(points.norm(dim=-1), module(depth))
    unit = torch.nn.functional.normalize(points, dim=-1)
    torch.testing.assert_close(unit, ray_directions(CAMERA).expand_as(unit))


def test_a_cropped_frame_and_an_unknown_condition_are_refused() -> None:
    module = module_of("distance_polynomial")
    frame: Any = torch.ones(5, 7)
    for passed, given, said in (
        ((frame[:4],), {}, r"expected shape \(..., 5, 7\)"),
        ((frame.numpy(),), {}, "expected a torch tensor, got ndarray"),
        ((frame.int(),), {}, "expected floating-point metres"),
        ((frame, frame[None]), {}, "expected depth's shape"),
        ((frame,), {"exposure": 1.0}, "'exposure' is no condition"),
        ((frame.expand(2, 5, 7),), {"timestamp_s": torch.ones(3)}, r"shape \[2\]; got \[3\]"),
    ):
        with pytest.raises(FrameError, match=said):
            module(*passed, **given)
    with pytest.raises(ConfigError, match=r"camera: expected a tofcorr.CameraIntrinsics, got str"):
        DepthCorrection("wall")  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("name", shipped_names("train"))
def test_every_shipped_configuration_builds_a_module(name: str) -> None:
    module = DepthCorrection(CAMERA, terms=name, ranges=DOMAIN)
    depth, amplitude = frames()
    assert torch.equal(module(depth, amplitude), depth)
    assert module.options.name in repr(module)


def test_terms_may_be_options_mappings_or_a_list_and_say_what_they_need() -> None:
    by_name = DepthCorrection(CAMERA, terms="ea")
    for terms in (by_name.options, by_name.terms, by_name.terms.terms, by_name.options.to_mapping(),
                  by_name.terms.to_mapping()["terms"]):  # fmt: skip
        assert DepthCorrection(CAMERA, terms=terms).terms == by_name.terms
    with pytest.raises(ConfigError, match="nor a configuration shipped"):
        DepthCorrection(CAMERA, terms="no_such_configuration")
    with pytest.raises(CalibrationDataError, match="pass ranges=recording"):
        DepthCorrection(CAMERA, terms="periodic")
