"""Masks of single images, True where a valid pixel is not used: outliers, other surfaces, edges."""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from tofcorr.data.recording import FrameBatch
from tofcorr.estimation.robust import deviation, fit_plane, largest_plane
from tofcorr.geometry.rays import Chosen, Images, Rays, plane_in_frame, ray_plane_distance


def some_pixels(used: Int[Tensor, "M"], most: int, seed: int) -> Int[Tensor, "S"]:
    """Return at most so many of an image's pixels, drawn at random, always the same for a seed."""
    if len(used) <= most:
        return used
    generator = torch.Generator().manual_seed(seed)
    return used[torch.randperm(len(used), generator=generator)[:most]]


def image_planes(
    batch: FrameBatch, ray_directions: Rays, enough: int | None = 4096
) -> Float[Tensor, "B 3"]:
    """Return g of the plane g . x = 1 of each image, fitted robustly in the camera frame.

    Args:
        batch: The images.
        ray_directions: Unit rays, shape (H, W, 3).
        enough: Valid pixels of an image that the fit needs; None: it takes all. The noise of as
            many as the default leaves a tenth of a millimetre, which is enough for masks.
    """
    # A board covers few pixels of a large image: those that no image shows need no arithmetic.
    seen = batch.valid.flatten(1).any(dim=0)
    seen[0] = True  # Without any column there is no median.
    rays = ray_directions.to(batch.radial_distance).flatten(0, 1)[seen]
    valid = batch.valid.flatten(1)[:, seen]
    step = 1 if enough is None else max(int(valid.sum(dim=1).min()) // max(enough, 1), 1)
    some = some_pixels(torch.arange(len(rays)), len(rays) // step, seed=0)
    return fit_plane(rays[some], batch.radial_distance.flatten(1)[:, seen][:, some], valid[:, some])


def _without_plane(batch: FrameBatch) -> Tensor:
    """Return which images have too few valid pixels for a plane of their own, (B, 1), bool."""
    return batch.valid.flatten(1).sum(dim=1, keepdim=True) < 3


def off_the_wall(batch: FrameBatch, rays: Rays, gross: float = 15.0, least: float = 0.05) -> Chosen:
    """Return which pixels are far off the plane of most of their image.

    Fewer than three pixels determine no plane; none of them is left out.

    Args:
        batch: The images.
        rays: Unit rays, shape (H, W, 3).
        gross: Largest deviation of a pixel on the wall, in times the image's median deviation.
        least: It is at least this, metres: a camera's own error varies by centimetres.
    """
    distance = torch.where(batch.valid, batch.radial_distance, torch.nan).flatten(1)
    off = deviation(rays.to(distance).flatten(0, 1), distance, image_planes(batch, rays)).abs()
    known = torch.where(off.isfinite(), off, torch.nan)
    limit = (gross * known.nanmedian(dim=1, keepdim=True).values).clamp(min=least)
    limit = torch.where(_without_plane(batch), torch.inf, limit)
    return ~(off <= limit).view(batch.valid.shape)


def off_largest_plane(batch: FrameBatch, rays: Rays, tolerance: float) -> Chosen:
    """Return which pixels are off the largest plane of their image.

    The same image always gives the same result: the frame's number seeds the search.

    Args:
        batch: The images.
        rays: Unit rays, shape (H, W, 3).
        tolerance: How far a pixel's distance may be from the plane's, metres. It must leave room
            for the camera's error across the image, which is what is to be calibrated.
    """
    off = torch.ones_like(batch.valid).flatten(1)
    for k, frame in enumerate(batch.indices.tolist()):
        usable = batch.valid[k].flatten().nonzero()[:, 0]
        distance = batch.radial_distance[k].flatten()[usable]
        own = rays.to(distance).flatten(0, 1)[usable]
        plane = largest_plane(own, distance, tolerance, torch.Generator().manual_seed(frame))
        if plane is not None:
            off[k, usable] = deviation(own, distance, plane).abs() > tolerance
    return off.view(batch.valid.shape)


def edges(batch: FrameBatch, contrast: float) -> Chosen:
    """Return which pixels are next to an edge of reflectivity: they mix light of two surfaces.

    Args:
        batch: The images.
        contrast: Brightest over darkest pixel of a 3 x 3 neighbourhood from which it is an edge.
    """
    if batch.amplitude is None:
        return torch.zeros_like(batch.valid)
    pool = torch.nn.functional.max_pool2d
    high = torch.where(batch.valid, batch.amplitude, 0.0)
    low = torch.where(batch.valid, batch.amplitude, torch.inf)
    brightest = pool(high[:, None], 3, stride=1, padding=1)[:, 0]
    darkest = -pool(-low[:, None], 3, stride=1, padding=1)[:, 0]
    return brightest > contrast * darkest


def grazing(batch: FrameBatch, limit_deg: float, rays: Rays) -> Chosen:
    """Return which pixels see the wall too obliquely, where multipath is large.

    The wall's direction is fitted to the measured points; no hand-eye transform is needed. Fewer
    than three points determine none, and are kept.

    Args:
        batch: The images.
        limit_deg: Largest angle between the ray and the wall's normal, degrees.
        rays: Unit rays, shape (H, W, 3).
    """
    normal = torch.nn.functional.normalize(image_planes(batch, rays), dim=1)
    cosine = torch.einsum("hwa,ba->bhw", rays.to(normal), normal).abs()
    return (cosine < math.cos(math.radians(limit_deg))) & ~_without_plane(batch)[:, :, None]


def raw_errors(batch: FrameBatch, rays: Rays, tool_from_camera: Float[Tensor, "4 4"]) -> Images:
    """Return measured less true distances along the rays, metres; NaN where a ray meets no plane.

    Args:
        batch: The images, with the planes that they show.
        rays: Unit rays, shape (H, W, 3).
        tool_from_camera: The hand-eye transform, shape (4, 4).
    """
    like, count = batch.radial_distance, len(batch.radial_distance)
    planes = batch.normal_tool, batch.offset_tool
    here = plane_in_frame(*planes, tool_from_camera.to(like).expand(count, 4, 4))
    return like - ray_plane_distance(rays.to(like), *here)
