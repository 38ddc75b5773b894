"""Light that reaches the target by diffuse surfaces beside it, relative to the direct light."""

import itertools
from typing import NamedTuple

import torch
from torch import Tensor

from tofcorr.simulation.effects.smooth_over_target import Seen

SIDES = (("left", 0, -1.0), ("right", 0, 1.0), ("below", 1, -1.0), ("above", 1, 1.0))
"""Where surfaces stand: name, axis of the target, and sign."""
BEYOND = {"near": 0.05, "far": 0.4}
"""Distance of a surface from the edge of the field of view on the target, in widths of that field.
Set by hand: a surface close by, and one farther away."""
# Patches of a surface: distances from the target, their depths, and positions along the edge
# relative to the point of the target, in widths of the field; all of one width. Set by hand: nine
# patches sum up to a smooth surface where it matters, near the target.
_BEFORE, _DEPTH = (0.05, 0.15, 0.4), (0.1, 0.15, 0.35)
_ASIDE = (-0.25, 0.0, 0.25)
_WIDTH = 0.25
# Smallest distance to a patch, metres: nearer patches are not point sources. Set by hand.
_NEAREST = 0.05
# Smallest cosine of the incidence angle used (87 degrees; no unit). Set by hand: keeps the ratio to
# the direct light finite.
_LEAST_COSINE = 0.05

Area = tuple[tuple[float, float], tuple[float, float]]


class _Surface(NamedTuple):
    """A surface at right angles to the target.

    Attributes:
        extent: Width of the field of view on the target, metres.
        wall: Its position across, metres.
    """

    extent: float
    wall: float


def light_by_surfaces(seen: Seen, area: Area, turn: float) -> Tensor:
    """Return the light by each surface at reflectivity one, relative to the direct light.

    Args:
        seen: Points of the target.
        area: Lowest and highest coordinates of the target that were seen, metres.
        turn: Radians a metre of distance.

    Returns:
        Complex, shape (F, N, 8), in the order of `SIDES` and `BEYOND`.
    """
    direct = seen.distance**2 / seen.cosine.clamp(min=_LEAST_COSINE)
    surfaces = [
        _light(_surface(area, axis, sign, beyond), _turned(seen, axis, sign), direct, turn)
        for (_, axis, sign), beyond in itertools.product(SIDES, BEYOND.values())
    ]
    return torch.stack(surfaces, dim=-1)


def _surface(area: Area, axis: int, sign: float, beyond: float) -> _Surface:
    """Place a surface beyond the edge of the area seen."""
    low, high = area
    extent = max(high[0] - low[0], high[1] - low[1])
    edge = high[axis] if sign > 0 else -low[axis]
    return _Surface(extent, edge + beyond * extent)


def _turned(seen: Seen, axis: int, sign: float) -> Seen:
    """Return points and cameras across a surface, along it, and up."""
    order = [axis, 1 - axis]
    flip = seen.xy.new_tensor([sign, 1.0])
    camera = torch.cat([seen.camera[:, order] * flip, seen.camera[:, 2:]], dim=1)
    return seen._replace(xy=seen.xy[..., order] * flip, camera=camera)


def _light(surface: _Surface, seen: Seen, direct: Tensor, turn: float) -> Tensor:
    """Return the light by one surface over the direct light, complex, shape (F, N).

    Args:
        surface: The surface.
        seen: Points and cameras across it, along it, and up.
        direct: Inverse of the direct light, shape (F, N), m^2.
        turn: Radians a metre of distance.
    """
    extent = surface.extent
    up, depth, aside = (extent * seen.xy.new_tensor(row) for row in (_BEFORE, _DEPTH, _ASIDE))
    lit = (surface.wall - seen.camera[:, 0]).clamp(min=0.0)[:, None, None, None]
    away = (surface.wall - seen.xy[..., 0])[..., None, None]
    along = seen.xy[..., 1, None] + aside - seen.camera[:, 1, None, None]
    height = (seen.camera[:, 2, None] - up)[:, None, None]
    first = (lit**2 + along[..., None] ** 2 + height**2).sqrt().clamp(min=_NEAREST)
    second = (away**2 + aside[:, None] ** 2 + up**2).sqrt().clamp(min=_NEAREST)
    # Three cosines, and the fall of the light on both parts of the path.
    strength = (
        (_WIDTH * extent / torch.pi)
        * (depth * up)
        * lit
        * away
        / (first**3 * second.square().square())
    )
    extra = first + second - seen.distance[..., None, None]
    light = torch.polar(strength * direct[..., None, None], turn / 2 * extra)
    return light.sum((-1, -2))
