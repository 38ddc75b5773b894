r"""Second bounces by walls that other frames of a recording show.

One frame shows a part of a room. Frames of known poses show more of it: large planes, each with a
brightness, which is its amplitude times the squared distance over the cosine of incidence. What
the camera would see beside its image is the nearest plane on each ray. The light is then that of
`tofcorr.scene_light.bounces`, from patches of even steps over the cone of the camera's light.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from tofcorr.geometry.rays import SPEED_OF_LIGHT
from tofcorr.scene_light.bounces import SecondBounces

_OFF_PLANE = 0.03
"""Share of its distance by which a point may miss its plane, as of large planes in one frame."""
_LEAST = 0.02
"""Least share of all points that makes a plane, and most that one may hide. Chosen."""
_TRIES = 200
"""Planes through three points that are tried. Chosen: one of half of the points is met surely."""
_SIDE = 12
"""Patches on either side of the cone of light, and points of a frame on a side. Set on rendered
walls: 24 change the light by 4 %."""


class Surroundings(NamedTuple):
    """Large planes n . p = offset.

    Attributes:
        normal: Unit vectors (K, 3).
        offset: Metres (K,).
        brightness: Amplitude of each at 1 m, seen straight on (K,).
        direct: Whether that is of the direct light alone; else of all that it sends.
    """

    normal: Tensor
    offset: Tensor
    brightness: Tensor
    direct: bool = False


class CameraLight(NamedTuple):
    """The light that a camera sends and measures.

    Attributes:
        world_from_camera: Pose of camera and light (4, 4), in the axes of the surroundings.
        half_angle: Of the cone of light about the optical axis, radians.
        frequency: Hz.
        gain: As in `SecondBouncesState`.
    """

    world_from_camera: Tensor
    half_angle: float
    frequency: float
    gain: float


def sampled(rays: Tensor) -> Tensor:
    """Return the pixels of rays (P, 3) that surroundings are found from, (Q,), int64."""
    generator = torch.Generator().manual_seed(0)
    return torch.randint(len(rays), (_SIDE**2,), generator=generator)


def surroundings_of(
    distance: Tensor, amplitude: Tensor, rays: Tensor, world_from_camera: Tensor, known: Tensor
) -> Surroundings:
    """Find the large planes that frames show.

    A plane that would hide more than a few of the points is no wall, and is left out.

    Args:
        distance: Along the rays of `sampled` pixels (F, P), metres; 0 or not finite: no return.
        amplitude: The same shape, at one integration time.
        rays: Unit rays of these pixels (P, 3).
        world_from_camera: Poses (F, 4, 4).
        known: Planes that are known, normal and offset (J, 4); they come first.
    """
    ray = rays @ world_from_camera[:, :3, :3].mT
    origin = world_from_camera[:, None, :3, 3].expand_as(ray)
    seen = (distance > 0) & distance.isfinite()
    ray, origin = ray[seen], origin[seen]
    distance, amplitude = distance[seen].double(), amplitude[seen].double()
    place, generator = origin + ray * distance[:, None], torch.Generator().manual_seed(0)

    def near(planes: Tensor) -> Tensor:
        """Return by which share of its distance each point misses planes (J, 4), (N, J)."""
        return (place @ planes[:, :3].T - planes[:, 3]).abs() / distance[:, None]

    planes, few = known, _LEAST * len(place) + 3
    free = (near(known) > _OFF_PLANE).all(1)
    while free.sum() > few:
        plane = _largest_plane(place[free], distance[free], generator)[None]
        own = free & (near(plane)[:, 0] < _OFF_PLANE)
        if own.sum() < few:
            break
        free = free & ~own
        through = (plane[:, 3] - origin @ plane[0, :3]) / (ray @ plane[0, :3])
        if ((through > 0) & (through < (1 - 2 * _OFF_PLANE) * distance)).sum() <= few:
            planes = torch.cat([planes, plane])
    if not len(planes):
        return Surroundings(planes[:, :3], planes[:, 3], planes[:, 3])
    missed, own = near(planes).min(1)
    bright = amplitude * distance.square() / (ray * planes[own, :3]).sum(1).abs()
    bright = torch.where(missed < _OFF_PLANE, bright, math.nan)
    each = [bright[own == number].nanmedian() for number in range(len(planes))]
    return Surroundings(planes[:, :3], planes[:, 3], torch.stack(each).nan_to_num(0.0))


def _largest_plane(place: Tensor, distance: Tensor, generator: torch.Generator) -> Tensor:
    """Return normal and offset (4,) of the plane that most points (N, 3) are on."""
    three = place[torch.randint(len(place), (_TRIES, 3), generator=generator)]
    normal = torch.linalg.cross(three[:, 1] - three[:, 0], three[:, 2] - three[:, 0])
    normal = torch.nn.functional.normalize(normal, dim=1)
    missed = (place @ normal.T - (normal * three[:, 0]).sum(1)).abs() / distance[:, None]
    near = (missed < _OFF_PLANE) & (normal.norm(dim=1) > 0.5)  # Three points on a line have none.
    own = near[:, near.sum(0).argmax()]
    middle = place[own].mean(0)
    normal = torch.linalg.svd(place[own] - middle, full_matrices=False).Vh[2]
    return torch.cat([normal, (normal @ middle)[None]])


def bounced(
    surroundings: Surroundings,
    light: CameraLight,
    place: Tensor,
    normal: Tensor,
    beside: tuple[Tensor, Tensor] | None = None,
) -> Tensor:
    """Return the second bounces at points over the direct light there, complex (N,).

    Args:
        surroundings: The planes that send light.
        light: Of the camera.
        place: Points that receive it (N, 3), metres.
        normal: Unit normals there, towards the camera (N, 3).
        beside: Least and largest x / z and y / z of an image, (2,) each, whose patches are left
            out. None: none is.
    """
    rotation, origin = light.world_from_camera[:3, :3], light.world_from_camera[:3, 3]
    pitch = 2 * math.tan(light.half_angle) / _SIDE
    line = (torch.arange(_SIDE, dtype=torch.float64) - (_SIDE - 1) / 2) * pitch
    slope = torch.cartesian_prod(line, line)
    ray = torch.nn.functional.normalize(torch.nn.functional.pad(slope, (0, 1), value=1.0))
    solid, ahead = pitch**2 * ray[:, 2] ** 3, ray[:, 2]
    ray = ray @ rotation.T
    met = (surroundings.offset - surroundings.normal @ origin) / (ray @ surroundings.normal.T)
    away, plane = torch.where(met > 0, met, math.inf).min(1)
    lit = away.isfinite() & (ahead >= math.cos(light.half_angle))
    sends = lit
    if beside is not None:
        sends = lit & ((slope < beside[0]) | (slope > beside[1])).any(1)
    ray, solid, away, plane, sends = (x[lit] for x in (ray, solid, away, plane, sends))
    facing = surroundings.normal[plane]
    cosine = (facing * ray).sum(1, keepdim=True)
    area = (solid * away.square() / cosine[:, 0].abs()).float()
    strength = (light.gain * surroundings.brightness[plane] * solid).float()
    # Places from the camera: single precision is a tenth of the time of double.
    patch, facing, length = (ray * away[:, None]).float(), (-facing * cosine.sign()).float(), away
    length, per_metre = length.float(), 2 * math.pi * light.frequency / SPEED_OF_LIGHT

    def received(at: Tensor, up: Tensor) -> Tensor:
        """Return what points get of each patch, over the direct light, complex (N, P)."""
        own, height = at.norm(dim=1, keepdim=True), -(at * up).sum(1, keepdim=True)
        square = (own.square() + length.square() - 2 * (at @ patch.T)).clamp(min=1e-6)
        kernel = (up @ patch.T + height).clamp(min=0)
        kernel = kernel * (at @ facing.T - (patch * facing).sum(1)).clamp(min=0)
        kernel = kernel * strength / (square * (square + area / math.pi))
        direct = own**3 / height.clamp(min=1e-6)
        return torch.polar(kernel * direct, per_metre * (length + square.sqrt() - own))

    between, turn = received(patch, facing), torch.ones_like(length, dtype=torch.complex64)
    for _ in range(2):
        turn = 1 + between @ turn
        turn = turn if surroundings.direct else turn / turn.abs()
    return (received((place - origin).float(), normal.float()) @ (turn * sends)).to(
        torch.complex128
    )


def added_around(
    bounces: SecondBounces,
    radial: Tensor,
    amplitude: Tensor,
    surroundings: Surroundings,
    world_from_camera: Tensor,
    half_angle_deg: float | None,
) -> tuple[Tensor, Tensor]:
    """Return distances and amplitudes with second bounces, also by what is beside the image.

    Args:
        bounces: Of the camera; its surfaces end with the image.
        radial: True distances, metres (H, W).
        amplitude: Of the direct light, or of all, as that of the surroundings (H, W).
        surroundings: What stands around the camera.
        world_from_camera: Its pose (4, 4).
        half_angle_deg: Of the cone of light; None: it reaches the corners of the image.
    """
    distance, brighter = bounces.added(radial, amplitude)
    if not surroundings.direct:  # The amplitude is that of all light as well.
        amplitude = amplitude.square() / brighter
        distance, brighter = bounces.added(radial, amplitude)
    cells, _ = bounces.cells(radial, amplitude)
    planes, *_ = bounces.planes(cells)
    rotation, origin = world_from_camera[:3, :3], world_from_camera[:3, 3]
    rays = bounces.rays.double().flatten(1)
    slopes, corner = (rays[:2] / rays[2]).T, math.acos(float(rays[2].min()))
    half_angle = corner if half_angle_deg is None else math.radians(half_angle_deg)
    wave_number = bounces.wave_numbers[bounces.weights.index(max(bounces.weights))]
    frequency = wave_number * SPEED_OF_LIGHT / (2 * math.pi)
    ratio = bounced(
        surroundings,
        CameraLight(world_from_camera, half_angle, frequency, bounces.gain),
        (bounces.cell_rays.double() * cells).T @ rotation.T + origin,
        -torch.nn.functional.normalize(planes.double(), dim=0).T @ rotation.T,
        (slopes.amin(0), slopes.amax(0)),
    )
    none = torch.zeros_like(cells)
    parts = [bounces.in_pixels(part, radial, none, planes) for part in (ratio.real, ratio.imag)]
    # Over all the light in view, whose phase is ahead of that of the direct light.
    ahead = torch.polar(amplitude / brighter, 2 * wave_number * (radial - distance))
    total = 1 + torch.complex(*parts) * ahead
    return distance + total.angle() / (2 * wave_number), brighter * total.abs()
