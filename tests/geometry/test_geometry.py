"""Laws of rays, distances, rigid transforms and planes."""

import math
from dataclasses import replace

import hypothesis.strategies as st
import pytest
import torch
from cameras import camera
from hypothesis import example, given

from tofcorr.geometry import se3
from tofcorr.geometry.rays import (
    phase_from_radial_distance,
    plane_in_frame,
    radial_distance_from_z_depth,
    ray_directions,
    ray_plane_distance,
    tangents,
    unambiguous_range,
    z_depth_from_radial_distance,
)

CAMERA = camera((64, 50), (90.0, 91.0), (32.2, 24.0), -0.08, 0.02, 0.0005, -0.0004, 0.01)

twists = st.lists(st.floats(-3.0, 3.0), min_size=6, max_size=6)


def test_rays_have_unit_length_and_that_of_the_principal_point_is_the_axis() -> None:
    norm = ray_directions(CAMERA).norm(dim=-1)
    torch.testing.assert_close(norm, torch.ones_like(norm), rtol=0, atol=1e-14)
    small = camera((5, 3), (4.0, 4.0), (2.0, 1.0))
    assert ray_directions(small)[1, 2].tolist() == [0.0, 0.0, 1.0]


def test_a_large_image_has_the_rays_of_a_small_one_at_the_same_pixels() -> None:
    # Its lens is undone part by part.
    large = replace(CAMERA, width=200, height=200)
    rays = ray_directions(large)
    torch.testing.assert_close(rays[:50, :64], ray_directions(CAMERA), rtol=0, atol=1e-15)
    u, v = rays[150, 120, :2] / rays[150, 120, 2]
    x, y = ray_directions(replace(large, height=151))[150, 120, :2].tolist()
    assert float(u / v) == pytest.approx(x / y, rel=1e-14)


@given(metres=st.floats(0.01, 100.0))
def test_radial_distance_and_z_depth_are_inverse(metres: float) -> None:
    rays = ray_directions(CAMERA)
    radial = torch.full((50, 64), metres, dtype=torch.float64)
    z_depth = z_depth_from_radial_distance(radial, rays)
    assert bool((z_depth <= radial).all())
    torch.testing.assert_close(radial_distance_from_z_depth(z_depth, rays), radial)


def test_mismatched_images_name_both_sizes() -> None:
    with pytest.raises(ValueError, match=r"share \(H, W\).*\[4, 5\].*\[50, 64\]"):
        z_depth_from_radial_distance(torch.ones(4, 5), ray_directions(CAMERA))


def test_twenty_megahertz_give_seven_and_a_half_metres() -> None:
    assert unambiguous_range(20e6) == pytest.approx(7.4948, abs=1e-4)
    full = torch.tensor(unambiguous_range(20e6))
    assert float(phase_from_radial_distance(full, 20e6)) == pytest.approx(2 * math.pi)


@given(values=twists)
@example(values=[0.0] * 6)
@example(values=[1.0, -2.0, 3.0, 1e-9, 0.0, 0.0])
def test_exponential_is_that_of_the_matrix(values: list[float]) -> None:
    twist = torch.tensor(values, dtype=torch.float64)
    x, y, z = values[3:]
    generator = torch.zeros(4, 4, dtype=torch.float64)
    cross = [[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]
    generator[:3, :3] = torch.tensor(cross, dtype=torch.float64)
    generator[:3, 3] = twist[:3]
    torch.testing.assert_close(se3.exp(twist), torch.linalg.matrix_exp(generator))


@given(values=twists)
def test_inverse_cancels(values: list[float]) -> None:
    transform = se3.exp(torch.tensor(values, dtype=torch.float64))
    eye = torch.eye(4, dtype=torch.float64)
    torch.testing.assert_close(transform @ se3.inverse(transform), eye, rtol=0, atol=1e-12)


@given(values=st.lists(st.floats(-1.5, 1.5), min_size=6, max_size=6))
@example(values=[0.0] * 6)
def test_logarithm_undoes_the_exponential_below_half_a_turn(values: list[float]) -> None:
    twist = torch.tensor(values, dtype=torch.float64)
    torch.testing.assert_close(se3.log(se3.exp(twist)), twist, rtol=0, atol=1e-7)


@given(values=twists)
def test_signed_distance_does_not_depend_on_the_frame(values: list[float]) -> None:
    world_from_frame = se3.exp(torch.tensor(values, dtype=torch.float64))
    normal = torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64)
    offset = torch.tensor(-1.7, dtype=torch.float64)
    points = torch.tensor([[0.1, 0.2, 0.3], [-4.0, 5.0, 6.0]], dtype=torch.float64)
    in_world = points @ world_from_frame[:3, :3].T + world_from_frame[:3, 3]
    there, height = plane_in_frame(normal, offset, world_from_frame)
    torch.testing.assert_close(points @ there + height, in_world @ normal + offset)


def test_ray_beside_or_away_from_the_plane_meets_it_nowhere() -> None:
    rays = torch.tensor([[[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 0.0, 1.0]]]).double()
    normal, offset = torch.tensor([0.0, 0.0, -1.0]).double(), torch.tensor(2.0).double()
    beside, away, towards = ray_plane_distance(rays, normal, offset)[0].tolist()
    assert math.isnan(beside)
    assert math.isnan(away)
    assert towards == 2.0


@given(components=st.lists(st.floats(-1.0, 1.0), min_size=3, max_size=3))
@example(components=[0.0, 0.0, 1.0])
@example(components=[1.0, 1.0, 1.0])
def test_a_normal_and_its_tangents_are_orthonormal(components: list[float]) -> None:
    normal = torch.tensor(components, dtype=torch.float64)
    if normal.norm() < 1e-3:
        return
    normal = normal / normal.norm()
    frame = torch.cat([normal[None], tangents(normal)])
    identity = torch.eye(3, dtype=torch.float64)
    torch.testing.assert_close(frame @ frame.T, identity, rtol=0, atol=1e-12)
    # A stack of normals gives the same as one by one.
    assert torch.equal(tangents(torch.stack([normal, -normal]))[0], tangents(normal))


def test_transforms_are_apart_by_their_distance_and_the_angle_between_them() -> None:
    first = torch.eye(4, dtype=torch.float64)
    first[:3, 3] = torch.tensor([1.0, 0.0, 0.0])
    second = torch.tensor(
        [[0.0, -1.0, 0.0, 1.0], [1.0, 0.0, 0.0, 3.0], [0.0, 0.0, 1.0, 4.0], [0.0, 0.0, 0.0, 1.0]]
    )
    assert se3.apart(first, second) == pytest.approx((5.0, math.pi / 2))


@pytest.mark.parametrize("size", [0.0, 1e-9, 0.01, 1.0])
def test_the_slope_of_the_logarithm_is_its_derivative(size: float) -> None:
    twist = size * torch.tensor([0.3, -0.5, 0.2, 0.4, 0.1, -0.6], dtype=torch.float64)

    def moved(step: torch.Tensor) -> torch.Tensor:
        return se3.log(se3.exp(twist) @ se3.exp(step))

    derivative = torch.autograd.functional.jacobian(moved, torch.zeros(6).double())
    torch.testing.assert_close(se3.log_slope(twist), derivative, rtol=0, atol=1e-12)
