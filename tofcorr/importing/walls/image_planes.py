"""The large planes of one depth image, by sequential RANSAC.

On the plane g . x = 1 the inverse distance is linear in the ray, 1 / D = g . ray, so that each fit
is a linear one. The search looks at a thinned image; all pixels are assigned afterwards.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from tofcorr.estimation.statistics import robust_scale, robust_weights
from tofcorr.importing.walls.image_plane import LEAST_SPREAD, ImagePlane, described
from tofcorr.importing.walls.options import WallOptions

# The search sees about this many pixels: enough for planes of 5 % of the image, and quick.
_SEARCHED_PIXELS = 5_000
# Each hypothesis is judged by at most this many of them: the share of a plane on 5 % of the image
# is then known to a tenth.
_JUDGES = 1_500
# Hypotheses a plane. Half draw their pixels close together: of a plane on 5 % of the image a
# triple from everywhere has all three with probability 1e-4, a triple of neighbours with 4 %.
_HYPOTHESES = 300
# Half the side of the window that neighbours come from, as a share of the image's diagonal.
# Set by hand: a square window is then about as large as a plane on 5 % of the image.
_WINDOW = 0.12
# This many of the best hypotheses are refined before one is chosen, in so many steps. Set by hand:
# three pixels with noise rank a good plane among the first, not always as the first.
_REFINED = 4
_REFINEMENTS = 4
# Pixels this many tolerances off a plane found are not searched again: the edge of a wall that the
# camera's error bends is not a second wall.
_USED_UP = 2.0
# Share of the neighbourhood (3 x 3 thinned pixels) that lies on the plane too where the pixel is
# part of a surface; a plane that cuts through other surfaces has thin strips only.
_DENSE = 0.6


@dataclass(frozen=True)
class _Searched:
    """The thinned image.

    Attributes:
        rays: Unit rays of its pixels with a return, shape (S, 3).
        distance: Along the ray, shape (S,), metres.
        place: Row and column of each in the thinned image, shape (S, 2).
        size: Rows and columns of the thinned image.
        stands_for: How many pixels of the image each one stands for.
    """

    rays: Tensor
    distance: Tensor
    place: Tensor
    size: tuple[int, int]
    stands_for: float


def find_planes(
    distance: Tensor, valid: Tensor, rays: Tensor, options: WallOptions, generator: torch.Generator
) -> list[ImagePlane]:
    """Find the large planes of one image, the largest first.

    Args:
        distance: Along the ray, shape (H, W), metres; undefined where not `valid`.
        valid: Where there is a measurement, shape (H, W).
        rays: Unit rays, shape (H, W, 3).
        options: Tolerance and least size.
        generator: Draws the hypotheses. The same state gives the same planes.
    """
    searched = _thinned(distance, valid, rays)
    least = options.least_share * distance.numel() / searched.stands_for
    tolerance = options.tolerance_mm * 1e-3
    left = torch.ones(len(searched.distance), dtype=torch.bool)
    gradients: list[Tensor] = []
    while len(gradients) < options.most_planes and int(left.sum()) >= max(least, 3):
        gradient = _largest(searched, left, tolerance, generator)
        if gradient is None:
            break
        on_plane = left & (_deviation(searched, gradient).abs() <= tolerance)
        if int(_dense(searched, on_plane).sum()) < least:
            break
        gradients.append(gradient)
        left &= _deviation(searched, gradient).abs() > _USED_UP * tolerance
    if not gradients:
        return []
    masks = plane_masks(distance, valid, rays, torch.stack(gradients), tolerance)
    planes = [
        described(distance, rays, mask, gradient)
        for mask, gradient in zip(masks, gradients, strict=True)
        if int(mask.sum()) >= options.least_share * distance.numel()
    ]
    return sorted(planes, key=lambda plane: -plane.support)


def only_plane(distance: Tensor, valid: Tensor, rays: Tensor) -> ImagePlane | None:
    """Return the plane of an image that shows one wall only; None if fewer than 3 pixels see it.

    A sensor of one pixel sees a plane of unknown normal: the normal is put opposite to the ray.

    Args:
        distance: Along the ray, shape (H, W), metres; undefined where not `valid`.
        valid: Where there is a measurement, shape (H, W).
        rays: Unit rays, shape (H, W, 3).
    """
    if int(valid.sum()) < min(3, valid.numel()):
        return None
    direction, measured = rays[valid].to(torch.float64), distance[valid].to(torch.float64)
    if valid.numel() == 1:
        normal, offset = -direction[0], float(measured[0])
        points = direction * measured[:, None]
        open_place = torch.full((3, 3), torch.inf, dtype=torch.float64)
        return ImagePlane(normal, offset, 1, LEAST_SPREAD, open_place, points)
    searched = _Searched(direction, measured, valid.nonzero(), (1, 1), 1.0)
    every = torch.ones(len(measured), dtype=torch.bool)
    mean = (direction * measured[:, None]).mean(dim=0)
    start = mean / mean.square().sum()
    gradient = _refined(searched, every, start, torch.inf)
    return described(distance, rays, valid, gradient)


def plane_masks(
    distance: Tensor, valid: Tensor, rays: Tensor, gradients: Tensor, tolerance: float
) -> Tensor:
    """Return which pixels lie on which plane, shape (K, H, W).

    A pixel near the line where two planes meet lies on neither: both explain it.

    Args:
        distance: Along the ray, shape (H, W), metres.
        valid: Where there is a measurement, shape (H, W).
        rays: Unit rays, shape (H, W, 3).
        gradients: The planes g . x = 1, shape (K, 3).
        tolerance: Largest deviation along the ray, metres.
    """
    near = near_planes(distance, valid, rays, gradients, tolerance)
    return near & (near.sum(dim=0) == 1)


def near_planes(
    distance: Tensor, valid: Tensor, rays: Tensor, gradients: Tensor, tolerance: float
) -> Tensor:
    """Return which pixels are near which plane, shape (K, H, W); arguments of `plane_masks`."""
    inverse = rays.flatten(0, 1).to(torch.float32) @ gradients.to(torch.float32).T
    fitted = torch.where(inverse > 0, 1 / inverse, torch.inf).T.unflatten(1, distance.shape)
    return valid & ((fitted - distance.to(torch.float32)).abs() <= tolerance)


def _thinned(distance: Tensor, valid: Tensor, rays: Tensor) -> _Searched:
    step = max(1, math.isqrt(distance.numel() // _SEARCHED_PIXELS))
    start = step // 2
    chosen = valid[start::step, start::step]
    place = chosen.nonzero()
    return _Searched(
        rays[start::step, start::step][chosen].to(torch.float64),
        distance[start::step, start::step][chosen].to(torch.float64),
        place,
        (chosen.shape[0], chosen.shape[1]),
        distance.numel() / chosen.numel(),
    )


def _deviation(searched: _Searched, gradient: Tensor) -> Tensor:
    """Return measured minus fitted distance, shape (S,); infinite where no ray meets the plane."""
    inverse = searched.rays @ gradient
    return torch.where(inverse > 0, searched.distance - 1 / inverse, torch.inf)


def _largest(
    searched: _Searched, left: Tensor, tolerance: float, generator: torch.Generator
) -> Tensor | None:
    """Return the plane that most of the pixels left lie on; None if every triple is degenerate."""
    usable = left.nonzero()[:, 0]
    judges = usable[torch.randperm(len(usable), generator=generator)[:_JUDGES]]
    triples = _triples(searched, usable, generator)
    matrix = searched.rays[triples]
    inverse = 1 / searched.distance[triples]
    sound = torch.linalg.det(matrix).abs() > 1e-6
    if not bool(sound.any()):
        return None
    gradients = torch.linalg.solve(matrix[sound], inverse[sound][:, :, None])[:, :, 0]
    best = _cost(searched, judges, gradients, tolerance).argsort(stable=True)[:_REFINED]
    candidates = [_refined(searched, left, gradients[k], tolerance) for k in best.tolist()]
    refined = torch.stack(candidates)
    return refined[int(_cost(searched, judges, refined, tolerance).argmin())]


def _triples(searched: _Searched, usable: Tensor, generator: torch.Generator) -> Tensor:
    """Draw triples of the pixels left, shape (T, 3): half anywhere, half within a window."""
    half = _HYPOTHESES // 2
    anywhere = torch.randint(len(usable), (half, 3), generator=generator)
    first = torch.randint(len(usable), (half, 1), generator=generator)
    reach = max(1, round(_WINDOW * math.hypot(*searched.size)))
    shift = torch.randint(-reach, reach + 1, (half, 2, 2), generator=generator)
    size = torch.tensor(searched.size)
    place = (searched.place[usable[first]] + shift).clamp(min=0).minimum(size - 1)
    number = torch.full(searched.size, -1)
    number[tuple(searched.place[usable].T)] = torch.arange(len(usable))
    others = number[place[..., 0], place[..., 1]]
    near = torch.cat([first, others], dim=1)[(others >= 0).all(dim=1)]
    return usable[torch.cat([anywhere, near])]


def _cost(searched: _Searched, judges: Tensor, gradients: Tensor, tolerance: float) -> Tensor:
    """Return the truncated squared deviations of the judges from each plane (Torr 2000), (T,)."""
    inverse = gradients.to(torch.float32) @ searched.rays[judges].to(torch.float32).T
    distance = searched.distance[judges].to(torch.float32)
    off = (distance - 1 / inverse.clamp(min=1e-6)) / tolerance
    return off.square().clamp(max=1.0).sum(dim=1)


def _refined(searched: _Searched, left: Tensor, gradient: Tensor, tolerance: float) -> Tensor:
    """Fit the plane to all pixels near it, robustly, and again to those near the fit."""
    for _ in range(_REFINEMENTS):
        off = _deviation(searched, gradient)
        near = left & (off.abs() <= tolerance)
        if int(near.sum()) < 3:
            return gradient
        rays, distance, off = searched.rays[near], searched.distance[near], off[near]
        scale = max(robust_scale(off), LEAST_SPREAD)
        weight = distance.pow(4) * robust_weights(off / scale, "cauchy")
        matrix = (weight[:, None] * rays).T @ rays
        ridge = 1e-12 * matrix.diagonal().sum() * torch.eye(3, dtype=matrix.dtype)
        gradient = torch.linalg.solve(matrix + ridge, rays.T @ (weight / distance))
    return gradient


def _dense(searched: _Searched, on_plane: Tensor) -> Tensor:
    """Return the pixels on the plane whose neighbours lie on it as well, shape (S,)."""
    image = torch.zeros(searched.size)
    image[searched.place[:, 0], searched.place[:, 1]] = on_plane.to(image)
    known = torch.zeros(searched.size)
    known[searched.place[:, 0], searched.place[:, 1]] = 1.0
    pool = torch.nn.functional.avg_pool2d
    share = pool(torch.stack([image, known])[:, None], 3, stride=1, padding=1)[:, 0]
    dense = share[0] >= _DENSE * share[1]
    return on_plane & dense[searched.place[:, 0], searched.place[:, 1]]
