"""Effects compared with what others know of the same physics."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from optional import present
from scipy import signal
from scipy.spatial.transform import Rotation
from torch import Generator

from tofcorr.simulation.effects.ambient_light import AmbientLightEffect
from tofcorr.simulation.effects.base import CatalogueEffect, EffectInputs, distance_to
from tofcorr.simulation.effects.lens import true_rays
from tofcorr.simulation.effects.mixed_pixels import MixedPixelsEffect, MixedPixelsShape
from tofcorr.simulation.effects.motion import MotionEffect, radial_speed
from tofcorr.simulation.effects.robot_kinematics import RobotKinematicsEffect
from tofcorr.simulation.effects.surface import GlossEffect
from tofcorr.simulation.effects.target_registration import TargetRegistrationEffect
from tofcorr.simulation.effects.temperature import (
    RoomTemperatureEffect,
    RoomTemperatureShape,
    WarmUpShape,
    heats,
    lagged_by,
)
from tofcorr.simulation.effects.timestamp_offset import TimestampOffsetEffect


def _shift(kind: type[CatalogueEffect], inputs: EffectInputs, **values: float) -> torch.Tensor:
    """Return the shift of an effect that has these coefficients, and zero for all others."""
    effect = kind.for_recording(inputs)
    names = _names(effect)
    assert set(values) <= set(names)
    given = torch.tensor([values.get(name, 0.0) for name in names], dtype=torch.float64)
    return effect.shift(inputs, given)


def _names(effect: CatalogueEffect) -> list[str]:
    return [term.name for term in effect.terms(effect.shape)]


def _with_facts(inputs: EffectInputs, **facts: torch.Tensor) -> EffectInputs:
    return replace(inputs, facts=replace(inputs.facts, **facts))


def test_the_lens_bends_rays_as_opencv_distorts_points(generator: Generator) -> None:
    points = torch.rand(50, 2, generator=generator, dtype=torch.float64) - 0.5
    rays = torch.cat([points, torch.ones(50, 1, dtype=torch.float64)], dim=1)
    k1, k2, p1, p2, s1, s3 = 0.1, -0.05, 0.004, -0.003, 0.006, -0.005
    bent = true_rays(rays, torch.tensor([0, 0, 0, 0, k1, k2, p2, p1, 0, s1, s3]).double(), 1.0)
    distortion = np.array([k1, k2, p1, p2, 0, 0, 0, 0, s1, 0, s3, 0])
    expected, _ = cv2.projectPoints(rays.numpy(), np.zeros(3), np.zeros(3), np.eye(3), distortion)
    np.testing.assert_allclose((bent[:, :2] / bent[:, 2:]).numpy(), expected[:, 0], atol=1e-12)


def test_a_skewed_lens_shears_the_image() -> None:
    rays = torch.tensor([[0.0, 0.2, 1.0]], dtype=torch.float64)
    bent = true_rays(rays, torch.tensor([0, 0, 0, 0, 0, 0, 0, 0, 0.01, 0, 0]).double(), 1.0)
    assert (bent[0, 0] / bent[0, 2]).item() == pytest.approx(0.002)


def test_a_lag_follows_a_broken_line_as_a_linear_system_does() -> None:
    times = torch.tensor([0.0, 40.0, 90.0, 800.0, 830.0], dtype=torch.float64)
    values = torch.tensor([22.0, 23.0, 22.5, 25.0, 24.0], dtype=torch.float64)
    fine = np.arange(0.0, 830.1, 0.5)
    straight = np.interp(fine, times.numpy(), values.numpy())
    system = signal.TransferFunction([1.0], [200.0, 1.0])
    _, followed, _ = signal.lsim(system, straight - 22.0, fine)
    expected = np.interp(times.numpy(), fine, followed) + 22.0
    np.testing.assert_allclose(lagged_by(200.0, times, values).numpy(), expected, atol=1e-6)


def test_the_heat_of_a_camera_does_not_depend_on_how_often_it_was_recorded() -> None:
    """Each frame left its own heat: three frames a station were three times as warm, 3 mm off."""
    shape = WarmUpShape(frame_interval_s=30.0)
    stations = torch.tensor([0.0, 30.0, 65.0, 80.0, 500.0, 540.0], dtype=torch.float64)
    often = torch.cat([stations, stations + 0.5, stations + 1.0]).sort().values
    once, thrice = (torch.stack(heats(times, shape)) for times in (stations, often))
    # In the pause of 420 s the camera ran for 90 s; the frames after 80 s let it run a second more.
    torch.testing.assert_close(thrice[:, torch.isin(often, stations)], once, atol=0.01, rtol=0)
    torch.testing.assert_close(thrice[:, 9], once[:, 3], atol=1e-12, rtol=0)


def test_a_camera_that_runs_warms_exponentially_and_cools_in_a_pause() -> None:
    shape = WarmUpShape(heat_s=(100.0,), frame_interval_s=10.0)
    times = torch.tensor([0.0, 20.0, 40.0, 340.0], dtype=torch.float64)
    (heat,) = heats(times, shape)
    warm = 1 - np.exp(-0.4)
    # Off for 270 s, then on for the 30 s before the last frame.
    last = 1 - (1 - warm * np.exp(-2.7)) * np.exp(-0.3)
    np.testing.assert_allclose(heat, [0.0, 1 - np.exp(-0.2), warm, last], atol=1e-12)


def test_a_camera_that_starts_warm_cools_exponentially(inputs: EffectInputs) -> None:
    times = torch.tensor([0.0, 50.0, 100.0, 1000.0], dtype=torch.float64)
    degrees = torch.full((4,), 22.0, dtype=torch.float64)
    still = _with_facts(inputs, timestamp=times, room_temperature=degrees)
    assert RoomTemperatureEffect.for_recording(still).shape.starts_s == (0.0, 1000.0)
    starts = {"lagged_200s_per_degree": 0.01, "start_0": 2.0, "start_1": -1.0}
    shift = _shift(RoomTemperatureEffect, still, **starts)
    of_frame = [float(shift[still.frame == frame][0]) for frame in range(4)]
    decay = np.exp(-times.numpy() / 200.0)
    expected = 0.02 * decay - 0.01 * np.array([0, 0, 0, 1.0])
    np.testing.assert_allclose(of_frame, expected, atol=1e-12)


def test_background_returned_by_the_target_knows_no_reflectivity(inputs: EffectInputs) -> None:
    effect = AmbientLightEffect.for_recording(inputs)
    names = _names(effect)
    darker = replace(inputs, amplitude=present(inputs.amplitude) / 5)
    bright_columns, dark_columns = effect.columns(inputs), effect.columns(darker)
    returned, uniform = names.index("returned_sine"), names.index("false_sine")
    torch.testing.assert_close(dark_columns[:, returned], bright_columns[:, returned])
    lit = bright_columns[:, uniform].abs() > 1e-3
    assert bool((dark_columns[lit, uniform].abs() > 2 * bright_columns[lit, uniform].abs()).all())


def test_a_pixel_astride_an_edge_is_known(inputs: EffectInputs) -> None:
    camera = inputs.camera
    image = torch.full((1, camera.height, camera.width), 100.0)
    image[:, :, 16:] = 400.0
    image[:, :, 16] = 250.0
    pixel = torch.arange(camera.height * camera.width)
    flat = replace(
        inputs,
        frame=torch.zeros_like(pixel),
        pixel=pixel,
        amplitude=image.double().reshape(-1),
        amplitude_images=image,
        distance_images=torch.ones_like(image),
        radial_distance=torch.full(pixel.shape, 2.0, dtype=torch.float64),
    )
    effect = MixedPixelsEffect(MixedPixelsShape())
    columns = effect.columns(flat).reshape(camera.height, camera.width, -1)
    two = ("astride", "astride_at_one_metre")
    astride, share = (columns[:, :, _names(effect).index(name)] for name in two)
    assert bool((astride[:, 16] > 0.9).all())
    assert bool((astride[:, [3, 10, 15, 17, 28]] < 1e-6).all())
    torch.testing.assert_close(share, astride / 2.0)


def test_a_room_temperature_of_other_recordings_knows_no_moments_of_this_one() -> None:
    shape = RoomTemperatureShape(starts_s=(0.0, 700.0))
    count = len(RoomTemperatureEffect.terms(shape))
    effect = RoomTemperatureEffect(shape, torch.arange(1.0, count + 1, dtype=torch.float64))
    found, kept = effect.in_other_recordings().to_mapping(), effect.to_mapping()
    assert not any(key.startswith("start_") for key in found)
    assert (found["per_degree"], found["square"]) == (kept["per_degree"], kept["square"])


def test_a_highlight_falls_with_the_square_of_the_angle(inputs: EffectInputs) -> None:
    angle = torch.deg2rad(torch.tensor([0.0, 4.0, 8.0, 40.0], dtype=torch.float64))
    four = replace(inputs, incidence_cosine=torch.cos(angle))
    shift = _shift(GlossEffect, four, lobe_4deg=-0.01)
    expected = -0.01 * torch.exp(torch.tensor([0.0, -1.0, -4.0, -100.0], dtype=torch.float64))
    torch.testing.assert_close(shift, expected, atol=5e-6, rtol=0)


def test_a_robot_that_is_too_short_scales_distances_beside_a_plane_and_a_camera_that_shift(
    inputs: EffectInputs,
) -> None:
    """Lengths have no scale: distances, arm, plane and mounting, all longer, look the same."""
    longer = 1.01
    facts, mounted = inputs.facts, inputs.tool_from_camera.clone()
    error = _shift(RobotKinematicsEffect, inputs, length=longer - 1)
    true = facts.world_from_tool.clone()
    true[:, :3, 3] *= longer
    moved = distance_to(inputs, replace(facts, world_from_tool=true))
    torch.testing.assert_close(inputs.radial_distance + error, moved)
    mounted[:3, 3] *= longer
    longer_facts = replace(facts, world_from_tool=true, offset=longer * facts.offset)
    scaled = distance_to(replace(inputs, tool_from_camera=mounted), longer_facts)
    torch.testing.assert_close(scaled, longer * inputs.radial_distance)


def test_a_bracket_bends_about_the_torque_of_its_weight(inputs: EffectInputs) -> None:
    """The same by SciPy: a camera that is 2 mrad heavy along z of the tool bends downwards."""
    shift = _shift(RobotKinematicsEffect, inputs, bracket_z=0.002)
    facts, turned = inputs.facts, torch.eye(4, dtype=torch.float64).repeat(4, 1, 1)
    down = facts.world_from_tool[:, :3, :3].mT @ torch.tensor([0.0, 0.0, -1.0]).double()
    torque = np.cross([0.0, 0.0, 0.002], down.numpy())
    turned[:, :3, :3] = torch.from_numpy(Rotation.from_rotvec(torque).as_matrix())
    bent = replace(inputs, tool_from_camera=turned @ inputs.tool_from_camera)
    moved = distance_to(bent, facts)
    assert (moved - inputs.radial_distance).abs().max() > 1e-4
    # Turns are exact to the second order: 2 mrad cubed, over a few metres.
    torch.testing.assert_close(inputs.radial_distance + shift, moved, atol=1e-8, rtol=0)


def test_rows_read_in_turn_see_the_target_in_turn(inputs: EffectInputs) -> None:
    twist = torch.tensor([[0.1, 0.0, 0.3, 0.0, 0.0, 0.0]], dtype=torch.float64).expand(4, 6)
    moving = _with_facts(inputs, tool_twist=twist)
    shift = _shift(MotionEffect, moving, half_of_rows_s=0.01)
    torch.testing.assert_close(shift, 0.01 * moving.rows * radial_speed(moving))


def test_clocks_that_drift_are_late_at_the_end_as_an_offset_is(inputs: EffectInputs) -> None:
    times = torch.tensor([0.0, 1.0, 3.0, 4.0], dtype=torch.float64)
    twist = torch.tensor([[0.1, 0.0, 0.3, 0.0, 0.2, 0.0]], dtype=torch.float64).expand(4, 6)
    exposure = torch.tensor([1e-3, 2e-3, 1e-3, 4e-3], dtype=torch.float64)
    moving = _with_facts(inputs, timestamp=times, tool_twist=twist, integration_time=exposure)

    def late(frame: int, **values: float) -> torch.Tensor:
        return _shift(TimestampOffsetEffect, moving, **values)[moving.frame == frame]

    torch.testing.assert_close(late(3, half_of_drift_s=0.02), late(3, offset_s=0.02))
    torch.testing.assert_close(late(1, half_of_drift_s=0.02), late(1, offset_s=-0.01))
    torch.testing.assert_close(late(3, exposures=5.0), late(3, offset_s=0.02))


def test_a_target_that_sinks_or_is_bumped_into_ends_where_an_error_of_its_place_is(
    inputs: EffectInputs,
) -> None:
    times = torch.tensor([0.0, 1.0, 2.5, 4.0], dtype=torch.float64)
    still = _with_facts(inputs, timestamp=times)

    def moved(frame: int, **values: float) -> torch.Tensor:
        return _shift(TargetRegistrationEffect, still, **values)[still.frame == frame]

    for name, shares in (("drift", (0.0, 0.25, 0.625, 1.0)), ("after_1of3", (0, 0, 1, 1))):
        for frame, share in enumerate(shares):
            found = moved(frame, **{f"offset_m_{name}": 0.01, f"lean_x_{name}": 0.005})
            expected = moved(frame, offset_m=0.01 * share, lean_x=0.005 * share)
            torch.testing.assert_close(found, expected)
    alone = TargetRegistrationEffect.for_recording(still).in_other_recordings()
    assert _names(alone) == ["offset_m", "lean_x", "lean_y"]
