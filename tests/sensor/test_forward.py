"""What a sensor model measures, against hand values, the corrector and the simulator."""

from typing import Any

import pytest
import torch
from seen_wall import seen_wall
from sensor.sensors import CAMERA, ERROR, FREQUENCY, NOISE, plane_scene, sensor_file, sensor_values

from tofcorr.conditions import condition
from tofcorr.correction.corrector import DepthCorrector
from tofcorr.correction.state import CalibrationState
from tofcorr.errors import FrameError
from tofcorr.geometry.rays import ray_directions
from tofcorr.sensor.model import SensorModel, SensorWarning

EFFECTS: dict[str, dict[str, Any]] = {
    "distance": {"legendre_1": 0.02, "legendre_5": -0.01},
    "pixel": {"x1_y0": 0.004, "x2_y2": 0.003, "growth_r2": 0.002},
    "amplitude": {"low_counts": 50.0, "high_counts": 2000.0, "log_2": 0.004, "square": 0.003},
    "wiggling": {"sin_4": 0.006, "cos_8": -0.002},
    "integration_time": {"reference_us": 400.0, "degree": 1, "log_1": -0.006},
    "warm_up": {"rise_200s": 0.008},
    "room_temperature": {"per_degree": 0.003},
    "ambient_light": {"share": 0.01, "false_sine": 0.004},
    "incidence_angle": {"secant": 0.03, "square": 0.02},
    "mixed_pixels": {"share_0.6px": 0.3},
    "stray_light": {"share_0.12": 0.1},
    "saturation": {"full_counts": 3000.0, "soft": 0.2, "knee_0.5": 0.3},
    "fixed_pattern": {"height": 12, "width": 16, "rms_m": 0.004, "seed": 3},
    "row_column_pattern": {"height": 12, "width": 16, "row_rms_m": 0.002, "column_rms_m": 0.001},
    "lens": {"focal_x": 0.01, "centre_y_px": 0.4, "radial_2": 0.02},
}
IN_SI = {
    "timestamp": 90.0,
    "integration_time": 800e-6,
    "room_temperature": 25.0,
    "ambient": 300.0,
}
CONDITIONS: dict[str, float] = {
    condition(name).column: condition(name).in_file(value) for name, value in IN_SI.items()
}


def simulated(effects: list[dict[str, Any]], amplitude: torch.Tensor, normal: torch.Tensor) -> Any:
    """Return the built-in simulator's expected measurement of the wall of `plane_scene`."""
    sensor = {"modulation_frequency_hz": FREQUENCY, "readout": {"converter_bits": 32}}
    plane = normal, torch.tensor(1.4, dtype=torch.float64)
    return seen_wall(CAMERA, sensor, plane, effects, IN_SI, amplitude_recorded=amplitude)


@pytest.mark.parametrize("name", EFFECTS)
def test_an_effect_is_that_of_the_simulator(name: str) -> None:
    effects = [{"name": name, **EFFECTS[name]}]
    depth, amplitude, normal = plane_scene()
    wanted = simulated(effects, amplitude, normal).measured_distance
    model = SensorModel(sensor_file(effects=effects), torch.float64)
    found = model(depth, amplitude, noise=False, **CONDITIONS).depth
    assert float((wanted - depth).abs().max()) > 1e-3
    torch.testing.assert_close(found, wanted, rtol=0, atol=1e-6)


@pytest.mark.parametrize("name", EFFECTS)
def test_an_effect_in_single_precision_is_that_in_double(name: str) -> None:
    """Within 3 um: float32 rounds a distance of 2 m to 0.1 um, and surfaces are differences."""
    model = sensor_file(effects=[{"name": name, **EFFECTS[name]}])
    depth, amplitude, _ = plane_scene()
    fine = SensorModel(model, torch.float64)(depth, amplitude, noise=False, **CONDITIONS).depth
    coarse = SensorModel(model)(depth.float(), amplitude.float(), noise=False, **CONDITIONS).depth
    assert coarse.dtype == torch.float32
    torch.testing.assert_close(coarse.double(), fine, rtol=0, atol=3e-6)


def test_a_lens_a_delay_and_a_mixed_signal_compose_as_in_the_simulator() -> None:
    names = ("lens", "distance", "fixed_pattern", "wiggling")
    effects = [{"name": name, **EFFECTS[name]} for name in names]
    depth, amplitude, normal = plane_scene()
    wanted = simulated(effects, amplitude, normal).measured_distance
    staged = sensor_file(effects=effects, effects_see="delayed_distance")
    found = SensorModel(staged, torch.float64)(depth, amplitude, noise=False, **CONDITIONS).depth
    torch.testing.assert_close(found, wanted, rtol=0, atol=1e-6)
    # Side by side, as a diagnosis fits them, their shifts add up.
    together = SensorModel(sensor_file(effects=effects), torch.float64)
    found = together(depth, amplitude, noise=False, **CONDITIONS).depth - depth
    alone = [
        SensorModel(sensor_file(effects=[effect]), torch.float64)(
            depth, amplitude, noise=False, **CONDITIONS
        ).depth
        - depth
        for effect in effects
    ]
    torch.testing.assert_close(found, torch.stack(alone).sum(0), rtol=0, atol=1e-12)


@pytest.mark.parametrize("kind", ["radial", "z"])
def test_the_corrector_undoes_the_error_terms(kind: str) -> None:
    section = ERROR | {"reads": "measured_distance"}
    model = SensorModel(sensor_file(error=section, depth_kind=kind), torch.float64)
    state = CalibrationState(
        name="test",
        error_model=model.base.model_options,
        domain=model.base.domain,
        coefficients=model.base.model.coefficient_vector(),
        tool_from_camera=torch.eye(4, dtype=torch.float64),
        hand_eye_estimated=False,
        camera=CAMERA,
        depth_kind=kind,  # type: ignore[arg-type]
    )
    depth, amplitude, _ = plane_scene(kind)
    with torch.no_grad():
        measured = model(depth, amplitude, noise=False).depth
        corrected, valid = DepthCorrector.from_state(state)(measured.float(), amplitude.float())
    assert bool(valid.all())
    assert float((measured - depth).abs().max()) > 5e-3
    # float32: a resolution of 1.2e-7 at 2 m.
    torch.testing.assert_close(corrected.double(), depth, rtol=0, atol=1e-6)


def test_terms_of_the_true_distance_are_added_as_they_stand() -> None:
    error = {
        "terms": [{"kind": "distance_polynomial", "degree": 1}],
        "coefficients": {"distance": {"c0": 0.01, "c1": -0.02}},
    }
    depth, _, _ = plane_scene()
    found = SensorModel(sensor_file(error=error), torch.float64)(depth, noise=False).depth
    torch.testing.assert_close(found, depth + 0.01 - 0.02 * depth, rtol=0, atol=1e-12)


def test_the_lens_follows_the_surface_of_each_pixel() -> None:
    """A step in depth: the lens bends each ray on its own side of the step."""
    depth, amplitude, _ = plane_scene()
    near = torch.where(torch.arange(16) < 8, depth - 0.5, depth)
    model = SensorModel(sensor_file(effects=[{"name": "lens", "focal_x": 0.01}]), torch.float64)
    with torch.no_grad():
        assert float((model(near, amplitude, noise=False).depth - near).abs().max()) < 0.03


def test_leading_dimensions_are_frames() -> None:
    effects = [{"name": name, **EFFECTS[name]} for name in ("mixed_pixels", "pixel", "lens")]
    model = SensorModel(sensor_file(error=ERROR, effects=effects))
    depth, amplitude, _ = plane_scene()
    scene = torch.stack([depth, depth + 0.2, depth + 0.4]).float().reshape(3, 1, 12, 16)
    light = amplitude.float().expand(scene.shape)
    whole = model(scene, light, noise=False).depth
    assert whole.shape == scene.shape
    assert whole.dtype == torch.float32
    for number in range(3):
        one = model(scene[number, 0], light[number, 0], noise=False).depth
        torch.testing.assert_close(whole[number, 0], one, rtol=0, atol=2e-6)


def test_effects_that_an_image_does_not_hold_are_named_with_the_reason() -> None:
    effects = [
        {"name": "multipath", "below_near": 0.3},
        {"name": "robot_kinematics", "scale_xx": 0.001},
        {"name": "target_registration", "offset_m": 0.001},
        {"name": "warm_up", "rise_200s": 0.01},
    ]
    with pytest.warns(SensorWarning, match="multipath: it belongs to the target and the room"):
        model = SensorModel(sensor_file(effects=effects))
    assert [sentence.split(":")[0] for sentence in model.left_out] == [
        "multipath",
        "robot_kinematics",
        "target_registration",
    ]
    depth, amplitude, _ = plane_scene()
    with pytest.warns(SensorWarning, match="warm_up: timestamp_s was not given"):
        alone = model(depth, amplitude, noise=False).depth
    torch.testing.assert_close(alone, depth, rtol=0, atol=1e-7)
    # Whatever could not be shown stays in the file.
    assert len(model.to_sensor_file().effects) == 4


def test_nothing_stays_nothing() -> None:
    depth, amplitude, _ = plane_scene()
    depth = depth.clone()
    depth[0, :4] = torch.tensor([torch.nan, 0.0, -1.0, torch.inf])
    effects = [{"name": name, **EFFECTS[name]} for name in ("mixed_pixels", "incidence_angle")]
    model = SensorModel(sensor_file(error=ERROR, effects=effects, noise=NOISE), torch.float64)
    depth.requires_grad_()
    measured = model(depth, amplitude, generator=torch.Generator().manual_seed(1))
    assert bool(measured.depth[0, :4].isnan().all())
    assert not bool(measured.valid[0, :4].any())
    assert bool(measured.valid[1:].all())
    measured.depth[measured.valid].sum().backward()
    assert depth.grad is not None
    assert bool(depth.grad.isfinite().all())


def test_frames_of_another_size_and_missing_light_are_refused() -> None:
    model = SensorModel(sensor_file(error=ERROR))
    with pytest.raises(FrameError, match=r"expected shape \(\.\.\., 12, 16\).*Render with the"):
        model(torch.ones(10, 16))
    with pytest.raises(FrameError, match="reflectivity: expected a torch tensor, got float"):
        model(torch.ones(12, 16), reflectivity=0.5)  # pyright: ignore[reportArgumentType]
    with pytest.raises(FrameError, match="no section 'light'"):
        model(torch.ones(12, 16))
    with pytest.raises(FrameError, match="'exposure' is no condition"):
        model(torch.ones(12, 16), torch.ones(12, 16), exposure=3.0)


def test_reflectivity_gives_the_amplitude_of_a_lambertian_surface() -> None:
    depth, _, normal = plane_scene()
    light = {"amplitude_at_1m": 1500.0, "vignetting_exponent": 2.0, "usual_reflectivity": 0.4}
    model = SensorModel(sensor_file(light=light), torch.float64)
    found = model(depth, reflectivity=torch.full_like(depth, 0.8), noise=False).amplitude
    rays = model.eye.rays
    wanted = 1500.0 * 0.8 * -(rays @ normal) * rays[..., 2] ** 2 / depth**2
    torch.testing.assert_close(found, wanted, rtol=1e-9, atol=0)
    usual = model(depth, noise=False).amplitude
    torch.testing.assert_close(usual, wanted / 2, rtol=1e-9, atol=0)


def test_conditions_far_beyond_their_range_count_as_an_eighth_beyond_it() -> None:
    """The squares of a temperature that was never measured once moved frames by 40 mm."""
    validity = sensor_file().validity.model_dump()
    validity["conditions"] = {"room_temperature_c": {"low": 20.0, "high": 24.0, "mean": 22.0}}
    effects = [{"name": "room_temperature", **EFFECTS["room_temperature"]}]
    model = SensorModel(sensor_file(effects=effects, validity=validity), torch.float64)
    depth, amplitude, _ = plane_scene()
    at = {
        degrees: model(depth, amplitude, noise=False, room_temperature_c=degrees).depth
        for degrees in (23.0, 24.0, 24.5, 30.0)
    }
    assert torch.equal(at[30.0], at[24.5])
    assert not torch.equal(at[24.5], at[24.0])
    torch.testing.assert_close(at[24.0] - at[23.0], torch.full_like(depth, 0.003))


def test_a_term_of_a_condition_is_added_frame_by_frame() -> None:
    ranges = {"low": 200.0, "high": 1000.0, "mean": 500.0}
    model = SensorModel(
        sensor_file(
            error={
                "terms": [{"kind": "integration_time", "degree": 1}],
                "coefficients": {"distance": {"c0": 0.0}, "condition": {"e1": 0.004}},
            },
            validity=sensor_values()["validity"] | {"conditions": {"integration_time_us": ranges}},
        ),
        torch.float64,
    )
    depth = plane_scene()[0].expand(4, -1, -1)
    # Half of the range is 400 us; beyond its end the error at the end is used; NaN is the mean.
    times = torch.tensor([500.0, 900.0, 4000.0, torch.nan])
    expected = torch.tensor([0.0, 0.004, 0.005, 0.0], dtype=torch.float64)
    seen = model(depth, noise=False, integration_time_us=times).depth - depth
    torch.testing.assert_close(seen, expected[:, None, None].expand_as(seen), rtol=0, atol=1e-12)
    assert torch.equal(model(depth, noise=False).depth, depth)


@pytest.mark.parametrize("kind", ["radial", "z"])
def test_the_ranges_covered_are_those_along_the_ray_in_which_the_sensor_was_measured(
    kind: str,
) -> None:
    error = ERROR | {"reads": "measured_distance"}
    model = SensorModel(sensor_file(depth_kind=kind, error=error))
    slant = ray_directions(CAMERA)[..., 2]
    for distance, inside in ((0.39, False), (0.41, True), (2.99, True), (3.01, False)):
        depth = distance * slant if kind == "z" else torch.full_like(slant, distance)
        assert bool((model.covers(depth) == inside).all())
    there = torch.full_like(slant, 1.0)
    for light, inside in ((49.0, False), (51.0, True), (5999.0, True), (6001.0, False)):
        assert bool((model.covers(there, torch.full_like(slant, light)) == inside).all())


def test_a_camera_that_counts_beyond_float16_measures_in_it() -> None:
    # 65535, the level of the shipped Kinect v2, stopped it with a RuntimeError.
    levels = {"base_share": 0.0, "saturation_amplitude": 65535.0}
    sensor = SensorModel(sensor_file(dropouts=levels), dtype=torch.float16)
    depth, amplitude, _ = (tensor.half() for tensor in plane_scene())
    measured = sensor(depth, amplitude, noise=False)
    assert measured.amplitude is not None
    assert measured.depth.dtype == torch.float16
    assert bool(torch.isfinite(measured.amplitude).all())
