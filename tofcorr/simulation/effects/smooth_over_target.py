"""Smooth functions of the point of the target, evaluated at few nodes of each frame.

What light on its way by a wall does to a pixel depends on where the pixel sees the target, and on
the camera's position. Within one frame it is smooth, so that a polynomial through a few nodes
replaces the evaluation in every pixel.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from tofcorr.simulation.effects.inputs import EffectInputs
from tofcorr.simulation.scene import planes_from_world

# Nodes in each direction of a frame that are tried, one after another. Chosen: the first is enough
# where no surface is nearer than a tenth of what a frame shows.
_NODES = (6, 9, 13)
# Root mean square error of the polynomials, as a share of that of the function. Chosen: far below
# the error of any model of a room.
_TOLERANCE = 0.01
# Pixels at which the polynomials are compared with the function. Chosen: their mean error is known
# to a tenth.
_COMPARED = 256
# Pixels that are computed at once where polynomials do not do. Chosen: a dozen arrays of them stay
# in a cache of 1 MB.
_PIXELS_AT_ONCE = 8192


class Seen(NamedTuple):
    """Points of the target that cameras see, N of each of F cameras.

    Attributes:
        xy: In the target's coordinates, shape (F, N, 2), metres.
        distance: From the camera, shape (F, N), metres.
        cosine: Of the angle of incidence, shape (F, N).
        camera: The camera in the target's coordinates, height positive, shape (F, 3), metres.
    """

    xy: Tensor
    distance: Tensor
    cosine: Tensor
    camera: Tensor


def in_every_pixel(function: Callable[[Seen], Tensor], inputs: EffectInputs, size: int) -> Tensor:
    """Return a function of the points seen in every pixel, shape (M, K); 0 off the target.

    Args:
        function: Takes F times N points and returns real values (F, N, K).
        inputs: The pixels.
        size: K.
    """
    known = inputs.target_xy.isfinite().all(1) & inputs.radial_distance.isfinite()
    if bool(known.all()):
        return _everywhere(function, inputs)
    values = inputs.radial_distance.new_zeros(len(known), size)
    if bool(known.any()):
        values[known] = _everywhere(function, _at(inputs, known))
    return values


def camera_over_target(inputs: EffectInputs) -> Tensor:
    """Return the camera's position in the target's coordinates, height positive, (F, 3), metres."""
    facts = inputs.facts
    camera = (facts.world_from_tool @ inputs.tool_from_camera)[:, :, 3]
    place = (planes_from_world(facts.normal_world, facts.offset) @ camera[:, :, None])[:, :3, 0]
    return torch.cat([place[:, :2], place[:, 2:].abs()], dim=1)


def _everywhere(function: Callable[[Seen], Tensor], inputs: EffectInputs) -> Tensor:
    """Return the values in pixels that all see the target, shape (M, K)."""
    count = len(inputs.frame)
    few = torch.linspace(0, count - 1, min(_COMPARED, count)).round().long().unique()
    camera = camera_over_target(inputs)
    exact = _in_pixels(function, inputs, camera, few)
    size = exact.square().mean(0).sqrt()
    for nodes in _NODES:
        surface = _Surface.through(function, inputs, camera, nodes)
        error = (surface.at(inputs, few) - exact).square().mean(0).sqrt()
        if bool((error <= _TOLERANCE * size).all()):
            return surface.at_all(inputs)
    parts = torch.arange(count).split(_PIXELS_AT_ONCE)
    return torch.cat([_in_pixels(function, inputs, camera, part) for part in parts])


def _in_pixels(
    function: Callable[[Seen], Tensor], inputs: EffectInputs, camera: Tensor, which: Tensor
) -> Tensor:
    """Return the values in some pixels, each as a frame of one point, shape (P, K)."""
    seen = Seen(
        inputs.target_xy[which, None],
        inputs.radial_distance[which, None],
        inputs.incidence_cosine[which, None],
        camera[inputs.frame[which]],
    )
    return function(seen)[:, 0]


def _at(inputs: EffectInputs, which: Tensor) -> EffectInputs:
    """Return the inputs of some pixels, as far as this module reads them."""
    return replace(
        inputs,
        frame=inputs.frame[which],
        radial_distance=inputs.radial_distance[which],
        incidence_cosine=inputs.incidence_cosine[which],
        target_xy=inputs.target_xy[which],
    )


class _Surface(NamedTuple):
    """A polynomial in both coordinates of the target for every frame.

    Attributes:
        coefficients: Of products of Chebyshev polynomials, shape (F, n * n, K).
        middle: Of what each frame shows, shape (F, 2), metres.
        half: Half of its extent, shape (F, 2), metres.
        nodes: The number n.
    """

    coefficients: Tensor
    middle: Tensor
    half: Tensor
    nodes: int

    @classmethod
    def through(
        cls,
        function: Callable[[Seen], Tensor],
        inputs: EffectInputs,
        camera: Tensor,
        nodes: int,
    ) -> "_Surface":
        """Put polynomials through the values at the Chebyshev nodes of every frame."""
        middle, half = _extent(inputs)
        angle = torch.pi * (torch.arange(nodes, dtype=torch.float64) + 0.5) / nodes
        one = torch.cos(angle)
        both = torch.cartesian_prod(one, one)
        xy = middle[:, None] + half[:, None] * both
        height = camera[:, None, 2]
        away = (xy - camera[:, None, :2]).square().sum(-1)
        distance = (away + height**2).sqrt()
        values = function(Seen(xy, distance, height / distance, camera))
        inverse = torch.linalg.inv(_chebyshev(one, nodes))
        return cls(torch.kron(inverse, inverse) @ values, middle, half, nodes)

    def at(self, inputs: EffectInputs, which: Tensor) -> Tensor:
        """Return the values in some pixels, shape (P, K)."""
        frame = inputs.frame[which]
        basis = self._basis(inputs.target_xy[which], frame)
        return (basis[:, None] @ self.coefficients[frame])[:, 0]

    def at_all(self, inputs: EffectInputs) -> Tensor:
        """Return the values in all pixels, shape (M, K)."""
        found = self.coefficients.new_empty(len(inputs.frame), self.coefficients.shape[-1])
        order = inputs.frame.argsort(stable=True)
        counts = torch.bincount(inputs.frame, minlength=len(self.middle)).tolist()
        for number, own in enumerate(order.split(counts)):
            if len(own):
                basis = self._basis(inputs.target_xy[own], inputs.frame[own])
                found[own] = basis @ self.coefficients[number]
        return found

    def _basis(self, xy: Tensor, frame: Tensor) -> Tensor:
        scaled = (xy - self.middle[frame]) / self.half[frame]
        of_x, of_y = (_chebyshev(scaled[:, axis], self.nodes) for axis in (0, 1))
        return (of_x[:, :, None] * of_y[:, None, :]).flatten(1)


def _extent(inputs: EffectInputs) -> tuple[Tensor, Tensor]:
    """Return middle and half extent of what each frame shows of the target, (F, 2), metres."""
    xy, frame = inputs.target_xy, inputs.frame[:, None].expand(-1, 2)
    none = xy.new_zeros(len(inputs.facts.offset), 2)
    low = none.scatter_reduce(0, frame, xy, "amin", include_self=False)
    high = none.scatter_reduce(0, frame, xy, "amax", include_self=False)
    # A frame of one pixel has no extent; any finite one serves.
    half = torch.where(high > low, (high - low) / 2, 1.0)
    return (low + high) / 2, half


def _chebyshev(scaled: Tensor, count: int) -> Tensor:
    """Return the first Chebyshev polynomials of values (M,), shape (M, count)."""
    columns = [torch.ones_like(scaled), scaled]
    for _ in range(2, count):
        columns.append(2 * scaled * columns[-1] - columns[-2])
    return torch.stack(columns[:count], dim=-1)
