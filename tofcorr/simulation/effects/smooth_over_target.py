"""Smooth functions of the point of the target, evaluated at few nodes of each frame.

What light on its way by a wall does to a pixel depends on where the pixel sees the target, and on
the camera's position. Within one frame it is smooth, so that a polynomial through a few nodes
replaces the evaluation in every pixel.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from tofcorr.simulation.effects.inputs import EffectInputs
from tofcorr.simulation.scene import planes_from_world

# Nodes in each direction of a frame that are tried, one after another. Chosen: on simulated walls
# seen from 0.5 to 1.8 m, nine are enough for most frames.
_NODES = (6, 9, 13, 18)
# Root mean square error of the polynomial of a frame, as a share of the root mean square of the
# function in all frames. Chosen: far below what any test of an effect can see.
_TOLERANCE = 1e-4
# Pixels of a frame, at least, at which its polynomial is compared with the function. Chosen: their
# root mean square is known to a tenth.
_COMPARED = 64
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
    camera, xy = camera_over_target(inputs), inputs.target_xy
    counts = torch.bincount(inputs.frame, minlength=len(camera)).tolist()
    pixels_of = inputs.frame.argsort(stable=True).split(counts)
    compared = [own[:: max(1, len(own) // _COMPARED)] for own in pixels_of]
    exact = _in_pixels(function, inputs, camera, torch.cat(compared))
    allowed = _TOLERANCE * exact.square().mean(0).sqrt()
    exact_of = exact.split([len(own) for own in compared])
    values = exact.new_empty(len(xy), exact.shape[1])
    left = [frame for frame, count in enumerate(counts) if count]
    for nodes in _NODES:
        # More nodes than pixels would save nothing.
        tried = [frame for frame in left if counts[frame] > nodes**2]
        if not tried:
            break
        extents = _extents([xy[pixels_of[frame]] for frame in tried])
        for frame, surface in zip(
            tried, _surfaces(function, extents, camera[tried], nodes), strict=True
        ):
            error = surface.at(xy[compared[frame]]) - exact_of[frame]
            if bool((error.square().mean(0).sqrt() <= allowed).all()):
                values[pixels_of[frame]] = surface.at(xy[pixels_of[frame]])
                left.remove(frame)
    for frame in left:
        for part in pixels_of[frame].split(_PIXELS_AT_ONCE):
            values[part] = _in_pixels(function, inputs, camera, part)
    return values


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
    """A polynomial in both coordinates of the target.

    Attributes:
        coefficients: Of products of Chebyshev polynomials, shape (n * n, K).
        middle: Of what the frame shows, shape (2,), metres.
        half: Half of its extent, shape (2,), metres.
        nodes: The number n.
    """

    coefficients: Tensor
    middle: Tensor
    half: Tensor
    nodes: int

    def at(self, xy: Tensor) -> Tensor:
        """Return the values at points (P, 2) of the target, metres, shape (P, K)."""
        of_x, of_y = (_chebyshev(v, self.nodes) for v in ((xy - self.middle) / self.half).unbind(1))
        return (of_x[:, :, None] * of_y[:, None, :]).flatten(1) @ self.coefficients


def _surfaces(
    function: Callable[[Seen], Tensor], extents: Tensor, camera: Tensor, nodes: int
) -> list[_Surface]:
    """Put polynomials through the values at the Chebyshev nodes of every frame.

    Args:
        function: Takes F times N points and returns real values (F, N, K).
        extents: Middle and half extent of what each frame shows, shape (F, 2, 2), metres.
        camera: As in `Seen`, shape (F, 3), metres.
        nodes: In each direction.
    """
    angle = torch.pi * (torch.arange(nodes, dtype=torch.float64) + 0.5) / nodes
    one = torch.cos(angle)
    xy = extents[:, :1] + extents[:, 1:] * torch.cartesian_prod(one, one)
    height = camera[:, None, 2]
    away = (xy - camera[:, None, :2]).square().sum(-1)
    distance = (away + height**2).sqrt()
    inverse = torch.linalg.inv(_chebyshev(one, nodes))
    values = function(Seen(xy, distance, height / distance, camera))
    found = torch.kron(inverse, inverse) @ values
    middle, half = extents.unbind(1)
    return [_Surface(*own, nodes) for own in zip(found, middle, half, strict=True)]


def _extents(points: Sequence[Tensor]) -> Tensor:
    """Return middle and half extent of sets of points (P, 2), shape (F, 2, 2), metres."""
    low = torch.stack([own.amin(0) for own in points])
    high = torch.stack([own.amax(0) for own in points])
    # Points on a line have no extent across it; any finite one serves.
    half = torch.where(high > low, (high - low) / 2, 1.0)
    return torch.stack([(low + high) / 2, half], dim=1)


def _chebyshev(scaled: Tensor, count: int) -> Tensor:
    """Return the first Chebyshev polynomials of values (M,), shape (M, count)."""
    columns = [torch.ones_like(scaled), scaled]
    for _ in range(2, count):
        columns.append(2 * scaled * columns[-1] - columns[-2])
    return torch.stack(columns[:count], dim=-1)
