r"""Second bounces by walls that other frames of a recording show.

One frame shows a part of a room. Frames of known poses show more of it: large planes, each with a
brightness, which is its amplitude times the squared distance over the cosine of incidence. What
the camera would see beside its image is the nearest plane on each ray. The light is then that of
`tofcorr.scene_light.bounces`, from patches of even solid angles before the camera. Those beyond the
cone of its light send on what the others send them: without them a sixth is missing in front of a
wall and a floor.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from tofcorr.geometry.rays import SPEED_OF_LIGHT
from tofcorr.scene_light.bounces import SecondBounces, transfer
from tofcorr.scene_light.planes import OFF_PLANE

_LEAST = 0.02
"""Least share of all points that makes a plane, and most that one may hide. Chosen."""
_PATCHES = 1296
"""Patches of the half sphere before the camera. Set on rendered walls: twice as many change the
light by 1 %."""
_COARSER = 4
"""Patches that are one for the light between them, which is smooth. Chosen: 16 change the light on
a wall beside two others by as little."""


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
    # Of a plane of the least share every frame shows three.
    return torch.randint(len(rays), (round(3 / _LEAST),), generator=generator)


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
    place = origin + ray * distance[:, None]
    found = large_planes(place, distance, known)
    through = (found[:, 3] - origin @ found[:, :3].T) / (ray @ found[:, :3].T)
    hidden = (through > 0) & (through < (1 - 2 * OFF_PLANE) * distance[:, None])
    planes = torch.cat([known, found[hidden.sum(0) <= _LEAST * len(place) + 3]])
    if not len(planes):
        return Surroundings(planes[:, :3], planes[:, 3], planes[:, 3])
    own = nearest_plane(place, distance, planes)
    bright = amplitude * distance.square() / (ray * planes[own, :3]).sum(1).abs()
    each = [bright[own == number].nanmedian() for number in range(len(planes))]
    return Surroundings(planes[:, :3], planes[:, 3], torch.stack(each).nan_to_num(0.0))


def large_planes(place: Tensor, distance: Tensor, known: Tensor) -> Tensor:
    """Return normal and offset (K, 4) of further large planes through points, largest first.

    Args:
        place: The points (N, 3), metres.
        distance: Of each from where it was seen (N,), metres.
        known: Planes that are known (J, 4).
    """
    planes, generator = known[:0], torch.Generator().manual_seed(0)
    free = nearest_plane(place, distance, known) < 0
    while free.sum() > (few := _LEAST * len(place) + 3):
        plane = _largest_plane(place[free], distance[free], generator)[None]
        own = free & (nearest_plane(place, distance, plane) == 0)
        if own.sum() < few:
            break
        planes, free = torch.cat([planes, plane]), free & ~own
    return planes


def nearest_plane(place: Tensor, distance: Tensor, planes: Tensor) -> Tensor:
    """Return which of planes (K, 4) each point is on (N,), the nearest; -1: on none."""
    off = (place @ planes[:, :3].T - planes[:, 3]).abs() / distance[:, None]
    off = torch.nn.functional.pad(off, (0, 1), value=OFF_PLANE)
    own = off.argmin(1)
    return torch.where(own < len(planes), own, -1)


def _largest_plane(place: Tensor, distance: Tensor, generator: torch.Generator) -> Tensor:
    """Return normal and offset (4,) of the plane that most points (N, 3) are on."""
    # So often that no three are on a plane of half of the points is as rare as rounding is small.
    tries = math.ceil(math.log(torch.finfo(torch.float64).eps) / math.log(1 - 0.5**3))
    three = place[torch.randint(len(place), (tries, 3), generator=generator)]
    normal = torch.linalg.cross(three[:, 1] - three[:, 0], three[:, 2] - three[:, 0])
    normal = torch.nn.functional.normalize(normal, dim=1)
    missed = (place @ normal.T - (normal * three[:, 0]).sum(1)).abs() / distance[:, None]
    near = (missed < OFF_PLANE) & (normal.norm(dim=1) > 0.5)  # Three points on a line have none.
    own, plane, middle = near[:, near.sum(0).argmax()], normal[0], place[0]
    for _ in range(2):
        middle = place[own].mean(0)
        plane = torch.linalg.svd(place[own] - middle, full_matrices=False).Vh[2]
        missed = ((place - middle) @ plane).abs() / distance
        # Points of another plane beside this one would turn it.
        own = own & (missed <= 3 * missed[own].median())
    return torch.cat([plane, (plane @ middle)[None]])


def _met(surroundings: Surroundings, origin: Tensor, ray: Tensor) -> tuple[Tensor, Tensor]:
    """Return how far rays (N, 3) go from a place (3,) to the first plane, and which it is (N,)."""
    met = (surroundings.offset - surroundings.normal @ origin) / (ray @ surroundings.normal.T)
    return torch.where(met > 0, met, math.inf).min(1)


def bounced(
    surroundings: Surroundings, light: CameraLight, place: Tensor, normal: Tensor
) -> Tensor:
    """Return the second bounces at points over the direct light there, complex (N,).

    Args:
        surroundings: The planes that send light.
        light: Of the camera.
        place: Points that receive it (N, 3), metres.
        normal: Unit normals there, towards the camera (N, 3).
    """
    rotation, origin = light.world_from_camera[:3, :3], light.world_from_camera[:3, 3]
    # Even steps along the axis are even solid angles; the golden ratio spreads them around it.
    number = torch.arange(_PATCHES, dtype=torch.float64)
    ahead, around = (1 - (number + 0.5) / _PATCHES).sqrt(), torch.pi * (5**0.5 - 1) * number
    across, solid = (1 - ahead.square()).sqrt(), torch.pi / (_PATCHES * ahead)
    ray = torch.stack([across * around.cos(), across * around.sin(), ahead], dim=1) @ rotation.T
    away, plane = _met(surroundings, origin, ray)
    there = away.isfinite()
    ray, away, plane, ahead, solid = (x[there] for x in (ray, away, plane, ahead, solid))
    facing = surroundings.normal[plane]
    cosine = (facing * ray).sum(1)
    # Places from the camera: single precision is a tenth of the time of double.
    area = (solid * away.square() / cosine.abs()).float()
    strength = (light.gain * surroundings.brightness[plane] * solid).float()
    patch, facing = (ray.T * away).float(), (-facing.T * cosine.sign()).float()
    length, per_metre = away.float(), 2 * torch.pi * light.frequency / SPEED_OF_LIGHT

    def received(at: Tensor, up: Tensor, each: int = 1) -> Tensor:
        """Return what points get of each patch if all are lit, over direct light, (N, P).

        Args:
            at: The points (3, N), from the camera, metres.
            up: Unit normals there (3, N).
            each: How many patches are one.
        """
        own, height = at.norm(dim=0)[:, None], -(at * up).sum(0)[:, None]
        share, way = transfer(at, up, patch[:, ::each], facing[:, ::each], each * area[::each])
        share = share * each * strength[::each] * torch.where(height > 0, own**3 / height, 0.0)
        return torch.polar(share, per_metre * (length[::each] + way - own))

    # What is not lit sends light on as well.
    lit = (ahead >= math.cos(light.half_angle)).to(torch.complex64)
    between, brighter = received(patch, facing, _COARSER), torch.ones_like(length)
    # As a camera sees them: solid angles, of what is lit.
    of_plane = torch.nn.functional.one_hot(plane, len(surroundings.offset)).float()
    weight = of_plane * (lit.real * solid.float())[:, None]
    weight = weight / weight.sum(0).clamp(min=solid.min())
    turn, before = lit, torch.zeros_like(lit)
    # Until a bounce changes less than patches of their size do.
    while ((turn / brighter - before).abs() @ weight).amax() > torch.pi / _PATCHES:
        before = turn / brighter
        turn = lit + between @ before[::_COARSER]
        if not surroundings.direct:
            mean = turn.abs() @ weight
            brighter = torch.where(mean > 0, mean, 1.0)[plane]
    light_there = received((place - origin).T.float(), normal.T.float()) @ (turn / brighter)
    return light_there.to(torch.complex128)


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
    cells, _ = bounces.cells(radial, amplitude)
    planes, fits, large = bounces.planes(cells)
    rotation, origin = world_from_camera[:3, :3], world_from_camera[:3, 3]
    ray = bounces.cell_rays.double().T @ rotation.T
    met, plane = _met(surroundings, origin, ray)
    # What is not before the planes is on them: measured, it seems farther by second bounces.
    alone = (cells < (1 - 2 * OFF_PLANE) * met) | ~met.isfinite()
    at = torch.where(alone, cells, met)
    normal = -torch.nn.functional.normalize(planes.double(), dim=0).T @ rotation.T
    flat = surroundings.normal[plane]
    flat = -flat * (flat * ray).sum(1, keepdim=True).sign()
    normal = torch.where(alone[:, None], normal, flat)
    half_angle = math.acos(float(bounces.rays[2].min()))
    if half_angle_deg is not None:
        half_angle = math.radians(half_angle_deg)
    wave_number = bounces.wave_numbers[bounces.weights.index(max(bounces.weights))]
    frequency = wave_number * SPEED_OF_LIGHT / (2 * math.pi)
    light = CameraLight(world_from_camera, half_angle, frequency, bounces.gain)
    ratio = bounced(surroundings, light, origin + ray * at[:, None], normal)
    none = torch.zeros_like(cells)
    parts = [bounces.in_pixels(part, radial, none, planes) for part in (ratio.real, ratio.imag)]
    ratio = torch.complex(*parts)
    if (fits & alone).any():  # What stands before the planes sends light as the frame shows it.
        distance, brighter = bounces.added(radial, amplitude, known=(planes, fits & alone, large))
        ahead = torch.polar(brighter / amplitude, 2 * wave_number * (distance - radial))
        ratio = ratio + torch.where(amplitude > 0, ahead - 1, 0.0)
    total = 1 + ratio
    factor = total.abs() if surroundings.direct else 1.0
    return radial + total.angle() / (2 * wave_number), amplitude * factor
