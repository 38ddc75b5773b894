"""Second bounces by what other frames show, against one frame that shows everything."""

import math

import torch

from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.geometry.rays import ray_directions
from tofcorr.scene_light.bounces import SecondBounces, SecondBouncesState
from tofcorr.scene_light.surroundings import (
    CameraLight,
    Surroundings,
    added_around,
    bounced,
    sampled,
    surroundings_of,
)

PLANES = torch.tensor([[0.0, 0.0, -1.0, -2.0], [0.0, 1.0, 0.0, 0.6]]).double()
"""A wall 2 m ahead and a floor 0.6 m below a camera at the origin, which looks along z."""
BRIGHT = torch.tensor([300.0, 400.0]).double()


def camera_of(width: int, height: int, focal: float) -> CameraIntrinsics:
    """Return a camera that looks along the middle of its image."""
    matrix = ((focal, 0.0, (width - 1) / 2), (0.0, focal, (height - 1) / 2), (0.0, 0.0, 1.0))
    return CameraIntrinsics(width=width, height=height, matrix=matrix)


def seen_by(camera: CameraIntrinsics) -> tuple[torch.Tensor, torch.Tensor]:
    """Return distances and amplitudes (H, W) of the wall and the floor."""
    cosine = ray_directions(camera) @ PLANES[:, :3].T
    each = torch.where(cosine * PLANES[:, 3] > 0, PLANES[:, 3] / cosine, math.inf)
    distance, plane = each.min(-1)
    slant = cosine.gather(-1, plane[..., None])[..., 0].abs()
    return distance, BRIGHT[plane] * slant / distance.square()


def test_planes_are_found_with_their_brightness() -> None:
    camera = camera_of(48, 48, 24.0)
    rays = ray_directions(camera).reshape(-1, 3)
    distance, amplitude = (image.reshape(1, -1) for image in seen_by(camera))
    pixel, pose = sampled(rays), torch.eye(4).double()[None]
    found = surroundings_of(distance[:, pixel], amplitude[:, pixel], rays[pixel], pose, PLANES[:1])
    assert len(found.offset) == 2
    sign = found.normal[1, 1].sign()
    torch.testing.assert_close(sign * found.normal[1], PLANES[1, :3], atol=1e-9, rtol=0.0)
    torch.testing.assert_close(sign * found.offset[1], PLANES[1, 3], atol=1e-9, rtol=0.0)
    torch.testing.assert_close(found.brightness, BRIGHT)


def test_a_board_before_the_wall_is_no_wall_that_hides_it() -> None:
    """An endless plane in the place of the board would hide most of the wall."""
    camera = camera_of(48, 48, 24.0)
    rays, (distance, amplitude) = ray_directions(camera), seen_by(camera)
    distance[10:20, 10:38] = 1.2 / rays[10:20, 10:38, 2]
    distance, amplitude = (image.reshape(1, -1) for image in (distance, amplitude))
    rays = rays.reshape(-1, 3)
    pixel, pose = sampled(rays), torch.eye(4).double()[None]
    found = surroundings_of(distance[:, pixel], amplitude[:, pixel], rays[pixel], pose, PLANES[:1])
    assert len(found.offset) == 2  # The wall and the floor.


def test_light_by_planes_is_that_of_one_frame_that_shows_them() -> None:
    """Up to a tenth: patches are of other sizes. Weak light, for beyond the frame it bounces on."""
    wide, half_angle = camera_of(64, 64, 12.0), math.radians(70.0)
    state = SecondBouncesState(
        frequencies_hz=(20e6,),
        gain=1e-5,
        patch_px=4,
        light_half_angle_deg=70.0,
        continued=False,
    )
    rays, (distance, amplitude) = ray_directions(wide), seen_by(wide)
    lit = torch.where(rays[..., 2] > math.cos(half_angle), distance, torch.nan)
    shift = SecondBounces(wide, state).added(lit, amplitude)[0] - lit
    rows, columns = torch.arange(16, 30, 4), torch.arange(16, 48, 6)
    at = torch.cartesian_prod(rows, columns).unbind(1)
    place = (rays * distance[..., None])[at]
    light = CameraLight(torch.eye(4).double(), half_angle, 20e6, 1e-5)
    around = Surroundings(PLANES[:, :3], PLANES[:, 3], BRIGHT, direct=True)
    found = bounced(around, light, place, PLANES[:1, :3].expand_as(place))
    metres = 299_792_458.0 / (4 * math.pi * 20e6)
    torch.testing.assert_close(metres * (1 + found).angle(), shift[at], rtol=0.1, atol=0.0)


def test_a_frame_without_the_floor_gets_its_light_where_other_frames_show_it() -> None:
    """The narrow image shows the wall alone: by itself it has no second bounces."""
    narrow, rays = camera_of(48, 16, 48.0), ray_directions(camera_of(48, 16, 48.0))
    state = SecondBouncesState(frequencies_hz=(20e6,), gain=1e-3, continued=False)
    distance, amplitude = seen_by(narrow)
    assert bool((rays[..., 1] * distance < 0.6).all())
    bounces, pose = SecondBounces(narrow, state), torch.eye(4).double()
    alone, _ = bounces.added(distance, amplitude)
    torch.testing.assert_close(alone, distance)
    around = Surroundings(PLANES[:, :3], PLANES[:, 3], BRIGHT, direct=True)
    found, brighter = added_around(bounces, distance, amplitude, around, pose, 44.0)
    light = CameraLight(pose, math.radians(44.0), 20e6, 1e-3)
    place = (rays * distance[..., None])[8, ::6]
    ratio = bounced(around, light, place, PLANES[:1, :3].expand_as(place))
    metres = 299_792_458.0 / (4 * math.pi * 20e6)
    expected = distance[8, ::6] + metres * (1 + ratio).angle()
    torch.testing.assert_close(found[8, ::6], expected, rtol=0.0, atol=1e-3)
    torch.testing.assert_close(
        brighter[8, ::6], amplitude[8, ::6] * (1 + ratio).abs(), rtol=0.02, atol=0.0
    )
    assert float((found - distance).min()) > 5e-3
