"""Which view to add: the information of views not yet taken, and a greedy choice among them."""

from copy import copy
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from tofcorr.estimation.accumulator import CHUNK_PIXELS, MomentAccumulator
from tofcorr.estimation.design import Design
from tofcorr.estimation.moments import ImageMoments, concatenate
from tofcorr.estimation.objective import MomentObjective, Parameters
from tofcorr.estimation.uncertainty import posterior_covariance
from tofcorr.geometry.planes import ray_plane_distance

# Exponent of the mean over the directions' variances. 1 would be A-optimality (their sum), infinity
# E-optimality (the largest alone), which ignores all directions but one. Set by hand in between.
_POWER = 4
# Side of a predicted checkerboard's squares, pixels; only its contrast matters. Set by hand.
_SQUARE_PIXELS = 4
# Larger images are predicted from about this many of their pixels. Set by hand.
_ENOUGH_PIXELS = 4000


class Views(NamedTuple):
    """Views of a wall that could be taken.

    Attributes:
        normal_tool: The wall's unit normals in the tool frame, shape (M, 3).
        offset_tool: Its offsets in the tool frame, shape (M,), metres.
        brightness: Logarithms of the normalised amplitude A D^2 / cosine of the dark and of the
            bright parts of the target, shape (M, 2).
    """

    normal_tool: Tensor
    offset_tool: Tensor
    brightness: Tensor


class Choice(NamedTuple):
    """The views chosen, in order.

    Attributes:
        order: Their indices.
        covariances: Of the unknowns before, and after each view, shape (1 + chosen, P, P).
    """

    order: list[int]
    covariances: Tensor


class _PredictedImages(NamedTuple):
    """What an error-free camera would measure; see `tofcorr.estimation.images.Images`."""

    radial_distance: Tensor
    amplitude: Tensor
    valid: Tensor
    normal_tool: Tensor
    offset_tool: Tensor


def predicted_moments(
    design: Design, tool_from_camera: Float[Tensor, "4 4"], views: Views, pixel_share: float = 1.0
) -> ImageMoments:
    """Return the moments that views would have if the camera had no error.

    Args:
        design: The columns.
        tool_from_camera: The hand-eye transform, shape (4, 4).
        views: The views.
        pixel_share: Share of the pixels that are usable.
    """
    step = max(1, round((design.ray_directions[..., 0].numel() / _ENOUGH_PIXELS) ** 0.5))
    design = _thinned(design, step)
    pixel_share = pixel_share * step**2
    accumulator = MomentAccumulator(design)
    rays = design.ray_directions
    size = max(1, CHUNK_PIXELS // rays[..., 0].numel())
    parts = []
    for chunk in torch.arange(len(views.offset_tool)).split(size):
        batch = _predicted_batch(rays, tool_from_camera, Views(*(part[chunk] for part in views)))
        weights = torch.full_like(batch.radial_distance, pixel_share)
        parts.append(accumulator(batch, weights))
    return concatenate(parts)


def _thinned(design: Design, step: int) -> Design:
    """Return the design on every `step`-th row and column: predicted images are smooth."""
    thin = copy(design)
    thin.ray_directions = design.ray_directions[::step, ::step]
    thin.pixel_functions = design.pixel_functions[:, ::step, ::step]
    return thin


def _predicted_batch(
    rays: Float[Tensor, "H W 3"], tool_from_camera: Float[Tensor, "4 4"], views: Views
) -> _PredictedImages:
    normal = views.normal_tool @ tool_from_camera[:3, :3]
    offset = views.normal_tool @ tool_from_camera[:3, 3] + views.offset_tool
    distance = ray_plane_distance(rays, normal, offset)
    cosine = -torch.einsum("hwa,ba->bhw", rays, normal)
    height, width = rays.shape[:2]
    rows = torch.arange(height)[:, None] // _SQUARE_PIXELS
    columns = torch.arange(width)[None, :] // _SQUARE_PIXELS
    bright = ((rows + columns) % 2).bool()
    brightness = torch.where(
        bright, views.brightness[:, 1, None, None], views.brightness[:, 0, None, None]
    )
    return _PredictedImages(
        radial_distance=distance,
        amplitude=brightness.exp() * cosine / distance.square(),
        valid=distance.isfinite() & (cosine > 0),
        normal_tool=views.normal_tool,
        offset_tool=views.offset_tool,
    )


def view_information(
    moments: ImageMoments, optimum: Parameters, variance: float
) -> Float[Tensor, "M P P"]:
    """Return the precision that each view would add, shape (M, P, P).

    Args:
        moments: Predicted moments of the views.
        optimum: The parameters so far.
        variance: The effective variance of a residual, square metres.
    """
    return MomentObjective(moments).image_equations(optimum).hessian / variance


def choose_views(
    precision: Float[Tensor, "P P"], candidates: Float[Tensor, "M P P"], number: int
) -> Choice:
    """Choose views greedily, each the one that most shrinks the weak directions' variances.

    Args:
        precision: Of the unknowns, from the recording, shape (P, P).
        candidates: The precision that each view would add, shape (M, P, P).
        number: How many to choose; each view can be chosen once.
    """
    order: list[int] = []
    covariances = [posterior_covariance(precision)]
    for _ in range(min(number, len(candidates))):
        after = posterior_covariance(precision + candidates)
        # tr(C^4) = sum of the fourth powers of the directions' variances.
        badness = torch.linalg.matrix_power(after, _POWER).diagonal(dim1=-2, dim2=-1).sum(-1)
        badness[order] = torch.inf
        best = int(badness.argmin())
        order.append(best)
        precision = precision + candidates[best]
        covariances.append(after[best])
    return Choice(order, torch.stack(covariances))


def worst_sigma(covariance: Float[Tensor, "P P"]) -> float:
    """Return the largest standard deviation of any direction, metres or radians."""
    return float(torch.linalg.eigvalsh(covariance)[-1].clamp(min=0).sqrt())
