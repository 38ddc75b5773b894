"""What a sensor model measures, against hand values, the corrector and the simulator."""

from typing import Any

import pytest
import torch
from optional import present
from seen_wall import seen_wall
from sensor.sensors import (
    CAMERA,
    CONDITIONS,
    EFFECTS,
    ERROR,
    FREQUENCY,
    IN_SI,
    NOISE,
    entries,
    plane_scene,
    sensor,
    sensor_file,
    sensor_values,
)

from tofcorr.correction.corrector import DepthCorrector
from tofcorr.correction.state import CalibrationState
from tofcorr.error_terms.model import ErrorModelOptions
from tofcorr.errors import FrameError
from tofcorr.geometry.rays import ray_directions
from tofcorr.sensor.model import SensorWarning


def simulated(effects: list[dict[str, Any]], amplitude: torch.Tensor, normal: torch.Tensor) -> Any:
    """Return the built-in simulator's expected measurement of the wall of `plane_scene`."""
    options = {"modulation_frequency_hz": FREQUENCY, "readout": {"converter_bits": 32}}
    plane = normal, torch.tensor(1.4, dtype=torch.float64)
    return seen_wall(CAMERA, options, plane, effects, IN_SI, amplitude_recorded=amplitude)


@pytest.mark.parametrize("name", EFFECTS)
def test_an_effect_is_that_of_the_simulator(name: str) -> None:
    depth, amplitude, normal = plane_scene()
    wanted = simulated(entries(name), amplitude, normal).measured_distance
    found = sensor(effects=entries(name))(depth, amplitude, noise=False, **CONDITIONS).depth
    assert float((wanted - depth).abs().max()) > 1e-3
    torch.testing.assert_close(found, wanted, rtol=0, atol=1e-6)
    # float32 rounds a distance of 2 m to 0.1 um, and surfaces are differences.
    single = sensor(torch.float32, effects=entries(name))
    coarse = single(depth.float(), amplitude.float(), noise=False, **CONDITIONS).depth
    assert coarse.dtype == torch.float32
    torch.testing.assert_close(coarse.double(), found, rtol=0, atol=3e-6)


def test_a_lens_a_delay_and_a_mixed_signal_compose_as_in_the_simulator() -> None:
    effects = entries("lens", "distance", "fixed_pattern", "wiggling")
    depth, amplitude, normal = plane_scene()

    def shift(effects: list[dict[str, Any]], **staged: Any) -> torch.Tensor:
        model = sensor(effects=effects, **staged)
        return model(depth, amplitude, noise=False, **CONDITIONS).depth - depth

    wanted = simulated(effects, amplitude, normal).measured_distance - depth
    found = shift(effects, effects_see="delayed_distance")
    torch.testing.assert_close(found, wanted, rtol=0, atol=1e-6)
    # Side by side, as a diagnosis fits them, their shifts add up.
    alone = torch.stack([shift([effect]) for effect in effects])
    torch.testing.assert_close(shift(effects), alone.sum(0), rtol=0, atol=1e-12)


@pytest.mark.parametrize("kind", ["radial", "z"])
def test_the_corrector_undoes_the_error_terms(kind: str) -> None:
    section = ERROR | {"reads": "measured_distance"}
    model = sensor(error=section, depth_kind=kind)
    state = CalibrationState(
        name="test",
        error_model=ErrorModelOptions(terms=model.sensor.error.terms),
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
    terms = [{"kind": "distance_polynomial", "degree": 1}]
    error = {"terms": terms, "coefficients": {"distance": {"c0": 0.01, "c1": -0.02}}}
    depth, _, _ = plane_scene()
    found = sensor(error=error)(depth, noise=False).depth
    torch.testing.assert_close(found, depth + 0.01 - 0.02 * depth, rtol=0, atol=1e-12)


def test_the_lens_follows_the_surface_of_each_pixel() -> None:
    """A step in depth: the lens bends each ray on its own side of the step."""
    depth, amplitude, _ = plane_scene()
    near = torch.where(torch.arange(16) < 8, depth - 0.5, depth)
    model = sensor(effects=[{"name": "lens", "focal_x": 0.01}])
    with torch.no_grad():
        assert float((model(near, amplitude, noise=False).depth - near).abs().max()) < 0.03


def test_leading_dimensions_are_frames() -> None:
    effects = entries("mixed_pixels", "pixel", "lens")
    model = sensor(torch.float32, error=ERROR, effects=effects)
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
        model = sensor(effects=effects)
    left_out = [sentence.split(":")[0] for sentence in model.left_out]
    assert left_out == ["multipath", "robot_kinematics", "target_registration"]
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
    effects = entries("mixed_pixels", "incidence_angle")
    model = sensor(error=ERROR, effects=effects, noise=NOISE)
    depth.requires_grad_()
    measured = model(depth, amplitude, generator=torch.Generator().manual_seed(1))
    assert bool(measured.depth[0, :4].isnan().all())
    assert not bool(measured.valid[0, :4].any())
    assert bool(measured.valid[1:].all())
    measured.depth[measured.valid].sum().backward()
    assert bool(present(depth.grad).isfinite().all())


def test_frames_of_another_size_and_missing_light_are_refused() -> None:
    model = sensor(error=ERROR)
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
    model = sensor(light=light)
    found = model(depth, reflectivity=torch.full_like(depth, 0.8), noise=False).amplitude
    rays = model.eye.ray_directions
    wanted = 1500.0 * 0.8 * -(rays @ normal) * rays[..., 2] ** 2 / depth**2
    torch.testing.assert_close(found, wanted, rtol=1e-9, atol=0)
    usual = model(depth, noise=False).amplitude
    torch.testing.assert_close(usual, wanted / 2, rtol=1e-9, atol=0)


def test_conditions_far_beyond_their_range_count_as_an_eighth_beyond_it() -> None:
    """The squares of a temperature that was never measured once moved frames by 40 mm."""
    validity = sensor_file().validity.model_dump()
    validity["conditions"] = {"room_temperature_c": {"low": 20.0, "high": 24.0, "mean": 22.0}}
    model = sensor(effects=entries("room_temperature"), validity=validity)
    depth, _, _ = plane_scene()
    degrees = torch.tensor([23.0, 24.0, 24.5, 30.0])
    at = model(depth.expand(4, -1, -1), noise=False, room_temperature_c=degrees).depth
    assert torch.equal(at[3], at[2])
    assert not torch.equal(at[2], at[1])
    torch.testing.assert_close(at[1] - at[0], torch.full_like(depth, 0.003))


def test_a_term_of_a_condition_is_added_frame_by_frame() -> None:
    ranges = {"low": 200.0, "high": 1000.0, "mean": 500.0}
    coefficients = {"distance": {"c0": 0.0}, "condition": {"e1": 0.004}}
    terms = [{"kind": "integration_time", "degree": 1}]
    validity = sensor_values()["validity"] | {"conditions": {"integration_time_us": ranges}}
    model = sensor(error={"terms": terms, "coefficients": coefficients}, validity=validity)
    depth = plane_scene()[0].expand(4, -1, -1)
    # Half of the range is 400 us; beyond its end the error at the end is used; NaN is the mean.
    times = torch.tensor([500.0, 900.0, 4000.0, torch.nan])
    expected = torch.tensor([0.0, 0.004, 0.005, 0.0], dtype=torch.float64)
    seen = model(depth, noise=False, integration_time_us=times).depth - depth
    torch.testing.assert_close(seen, expected[:, None, None].expand_as(seen), rtol=0, atol=1e-12)
    assert torch.equal(model(depth, noise=False).depth, depth)


@pytest.mark.parametrize("kind", ["radial", "z"])
def test_the_ranges_covered_are_those_of_the_measurement_along_the_ray(kind: str) -> None:
    error = ERROR | {"reads": "measured_distance"}
    model = sensor(torch.float32, depth_kind=kind, error=error)
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
    camera = sensor(torch.float16, dropouts=levels)
    depth, amplitude, _ = (tensor.half() for tensor in plane_scene())
    measured = camera(depth, amplitude, noise=False)
    assert measured.depth.dtype == torch.float16
    assert bool(torch.isfinite(present(measured.amplitude)).all())


def test_true_distances_are_held_to_their_own_range() -> None:
    """Second bounces of 60 mm once put the nearest pixels out of the range of what was measured."""
    ranges = {"radial_distance_m": [1.0, 2.0], "true_radial_distance_m": [0.5, 2.5]}
    terms = [{"kind": "distance_polynomial", "degree": 1}]
    error = {"terms": terms, "coefficients": {"distance": {"c0": 0.0, "c1": 0.004}}}
    base = sensor(error=error, validity=sensor_values()["validity"] | ranges).base
    like = plane_scene()[0]
    distances = (0.4, 0.5, 1.5, 2.5, 2.6)
    found = [base(torch.full_like(like, at), like, None).mean() for at in distances]
    assert found[0] == found[1]
    assert found[3] == found[4]
    assert abs(found[1] - found[2]) > 0.001
    torch.testing.assert_close(found[1] + found[3], 2 * found[2])
