"""Which pixels are used: masks against outliers, other surfaces, edges and grazing incidence."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from pydantic import Field, PositiveFloat
from torch import Tensor

from tofcorr.data.recording import FrameBatch
from tofcorr.errors import CalibrationDataError
from tofcorr.estimation.statistics import robust_weights
from tofcorr.geometry.planes import ray_plane_distance
from tofcorr.options import Options
from tofcorr.pixels.dataset import Dataset, recorded_hand_eye
from tofcorr.pixels.sample import some_pixels
from tofcorr.spread import sigma_from_mad

# Pixels of an image that its plane is fitted to where a mask only compares with it: their noise
# leaves a tenth of a millimetre, and a mask's tolerance is of centimetres. Chosen.
_ENOUGH_FOR_MASKS = 4096

Mask = Callable[[FrameBatch], Bool[Tensor, "B H W"]]
"""Returns True where a valid pixel of a batch is not used."""


class ImagePlanes(NamedTuple):
    """The planes that images look at.

    Attributes:
        normal: Unit normals in the camera frame, towards the camera, shape (B, 3).
        offset: Distances of the camera from the planes, shape (B,), metres.
        deviation: Measured minus fitted distance along the ray, shape (B, H, W), metres; NaN
            where a pixel is not valid.
    """

    normal: Tensor
    offset: Tensor
    deviation: Tensor


def image_planes(
    batch: FrameBatch, ray_directions: Float[Tensor, "H W 3"], enough: int | None = None
) -> ImagePlanes:
    """Fit a plane to each image, robustly (Cauchy weights).

    On the plane n . x + d = 0 the inverse distance is linear in the ray: 1 / D = -(n . ray) / d.

    Args:
        batch: The images.
        ray_directions: Unit rays, shape (H, W, 3).
        enough: Valid pixels of an image that the fit needs; None: it takes all.
    """
    # A board covers few pixels of a large image: those that no image shows need no arithmetic.
    seen = batch.valid.flatten(1).any(dim=0)
    seen[0] = True  # Without any column there is no median.
    rays = ray_directions.to(batch.radial_distance).flatten(0, 1)[seen]
    valid = batch.valid.flatten(1)[:, seen]
    distance = torch.where(valid, batch.radial_distance.flatten(1)[:, seen], 1.0)
    step = 1 if enough is None else max(int(valid.sum(dim=1).min()) // max(enough, 1), 1)
    some = some_pixels(torch.arange(len(rays)), len(rays) // step, seed=0)
    gradient = _inverse_planes(distance[:, some], valid[:, some], rays[some])
    length = gradient.norm(dim=1, keepdim=True).clamp(min=1e-12)
    fitted = gradient @ rays.T
    deviation = torch.full(batch.valid.shape, torch.nan).to(distance)
    deviation.flatten(1)[:, seen] = torch.where(
        valid & (fitted > 0), distance - 1 / fitted, torch.nan
    )
    return ImagePlanes(-gradient / length, 1 / length[:, 0], deviation)


def _inverse_planes(
    distance: Float[Tensor, "B V"],
    valid: Bool[Tensor, "B V"],
    rays: Float[Tensor, "V 3"],
    iterations: int = 15,
) -> Float[Tensor, "B 3"]:
    """Return g of 1 / D = g . ray of each image, fitted robustly to its valid pixels.

    Reweighting has settled after 15 iterations.
    """
    inverse = 1 / distance
    weight = valid.to(inverse)
    gradient = rays.new_zeros(len(distance), 3)
    ridge = 1e-12 * torch.eye(3).to(inverse)
    for _ in range(iterations):
        matrix = torch.einsum("bv,va,vc->bac", weight, rays, rays)
        right = torch.einsum("bv,va->ba", weight * inverse, rays)
        gradient = torch.linalg.solve(matrix + ridge, right[:, :, None])[:, :, 0]
        # Deviations as distances, not as inverse distances: their noise is of one size.
        off = (inverse - gradient @ rays.T) * distance.square()
        among = torch.where(valid, off.abs(), torch.nan).nanmedian(dim=1, keepdim=True).values
        scale = sigma_from_mad(among).clamp(min=1e-6)
        # The factor makes a least-squares fit of inverse distances one of distances.
        weight = valid * robust_weights(off / scale, "cauchy") * distance.square().square()
        weight = weight.nan_to_num(0.0)
    return gradient


def off_the_wall(rays: Float[Tensor, "H W 3"], gross: float = 15.0, least: float = 0.05) -> Mask:
    """Return the mask of pixels far off the plane of most of their image.

    Args:
        rays: Unit rays, shape (H, W, 3).
        gross: Largest deviation of a pixel on the wall, in times the image's median deviation.
        least: It is at least this, metres: a camera's own error varies by centimetres.
    """

    def mask(batch: FrameBatch) -> Tensor:
        deviation = image_planes(batch, rays, _ENOUGH_FOR_MASKS).deviation.abs()
        limit = (gross * deviation.flatten(1).nanmedian(dim=1).values).clamp(min=least)
        return ~(deviation <= limit[:, None, None])

    return mask


def off_largest_plane(
    rays: Float[Tensor, "H W 3"], tolerance: float, triples: int = 300, judges: int = 2000
) -> Mask:
    """Return the mask of pixels off the largest plane of their image (Fischler and Bolles 1981).

    The same image always gives the same result: the frame's number seeds the random triples.

    Args:
        rays: Unit rays, shape (H, W, 3).
        tolerance: How far a pixel's distance may be from the plane's, metres. It must leave room
            for the camera's error across the image, which is what is to be calibrated.
        triples: Of pixels drawn in each image. With a third of the pixels on the wall, 300 all
            miss it with probability (1 - 1/27)^300 = 1e-5.
        judges: Pixels of the image, at most, on which the planes of the triples are compared.
    """

    def nearest(distance: Tensor, valid: Tensor, frame: int) -> Tensor:
        """Return the pixels near the best triple's plane: the one with most pixels near it."""
        usable, here = valid.flatten().nonzero()[:, 0], rays.to(distance)
        flat_rays, flat = here.flatten(0, 1), distance.flatten()
        if len(usable) < 3:
            return torch.zeros_like(valid)
        generator = torch.Generator().manual_seed(frame)
        among = usable[torch.randperm(len(usable), generator=generator)[:judges].to(usable)]
        drawn = torch.randint(len(usable), (triples, 3), generator=generator).to(usable)
        points = flat_rays[usable[drawn]] * flat[usable[drawn], None]
        normal = torch.linalg.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])
        length = normal.norm(dim=1, keepdim=True)
        normal = normal / length.clamp(min=1e-12)
        offset = (normal * points[:, 0]).sum(dim=1)
        met = offset[:, None] / (normal @ flat_rays[among].T)
        votes = ((met - flat[among]).abs() <= tolerance).sum(dim=1)
        votes[length[:, 0] < 1e-9] = 0
        best = int(votes.argmax())
        return valid & ((offset[best] / (here @ normal[best]) - distance).abs() <= tolerance)

    def mask(batch: FrameBatch) -> Tensor:
        images = zip(batch.radial_distance, batch.valid, batch.indices.tolist(), strict=True)
        near = torch.stack([nearest(*image) for image in images])
        # The camera's error bends the measured wall: a plane fitted to much of it is better
        # than that of three pixels.
        for _ in range(3):
            planes = image_planes(replace(batch, valid=near), rays, _ENOUGH_FOR_MASKS)
            fitted = -planes.offset[:, None, None] / torch.einsum(
                "hwa,ba->bhw", rays.to(planes.normal), planes.normal
            )
            near = batch.valid & ((batch.radial_distance - fitted).abs() <= tolerance)
        return ~near

    return mask


def edges(contrast: float) -> Mask:
    """Return the mask of pixels next to an edge of reflectivity, which mix light of two surfaces.

    Args:
        contrast: Brightest over darkest pixel of a 3 x 3 neighbourhood from which it is an edge.
    """

    def mask(batch: FrameBatch) -> Tensor:
        if batch.amplitude is None:
            return torch.zeros_like(batch.valid)
        pool = torch.nn.functional.max_pool2d
        high = torch.where(batch.valid, batch.amplitude, 0.0)
        low = torch.where(batch.valid, batch.amplitude, torch.inf)
        brightest = pool(high[:, None], 3, stride=1, padding=1)[:, 0]
        darkest = -pool(-low[:, None], 3, stride=1, padding=1)[:, 0]
        return brightest > contrast * darkest

    return mask


def grazing(limit_deg: float, rays: Float[Tensor, "H W 3"]) -> Mask:
    """Return the mask of pixels that see the wall too obliquely, where multipath is large.

    The wall's direction is fitted to the measured points; no hand-eye transform is needed.

    Args:
        limit_deg: Largest angle between the ray and the wall's normal, degrees.
        rays: Unit rays, shape (H, W, 3).
    """

    def mask(batch: FrameBatch) -> Tensor:
        normal = image_planes(batch, rays, _ENOUGH_FOR_MASKS).normal
        cosine = torch.einsum("hwa,ba->bhw", rays.to(normal), normal).abs()
        return cosine < math.cos(math.radians(limit_deg))

    return mask


def without_outliers(
    dataset: Dataset,
    window_mm: float | None,
    frames: Sequence[int] | np.ndarray | None = None,
    pixels: int = 2_000_000,
) -> Dataset:
    """Return the data set with every pixel left out whose raw error is off by more than a window.

    Mixed pixels at edges, reflections and misplaced masks are off by decimetres; the errors to be
    calibrated are centimetres. In a squared loss a few such pixels would outweigh all others. The
    raw error is measured minus true distance along the ray, the true one from the target's plane
    under the recorded hand-eye transform.

    Args:
        dataset: The recordings.
        window_mm: Largest distance from the median raw error, millimetres; None keeps all.
        frames: Global numbers of the frames that the median is taken over; None: all.
        pixels: About how many, evenly spread, the median is taken over.

    Raises:
        CalibrationDataError: No usable pixel looks at its plane.
    """
    if window_mm is None:
        return dataset
    transform, rays = recorded_hand_eye(dataset), dataset.ray_directions()

    def raw_error(batch: FrameBatch) -> Tensor:
        """Return raw errors, shape (B, H, W), metres; NaN where a ray meets no plane."""
        at, here = transform.to(batch.normal_tool), rays.to(batch.radial_distance)
        normal = batch.normal_tool @ at[:3, :3]
        offset = batch.normal_tool @ at[:3, 3] + batch.offset_tool
        return batch.radial_distance - ray_plane_distance(here, normal, offset)

    num_frames = dataset.num_frames if frames is None else len(frames)
    step = -(-num_frames * rays[..., 0].numel() // pixels)
    errors = [
        raw_error(batch)[batch.valid & batch.radial_distance.isfinite()][::step]
        for batch in dataset.batches(frames)
    ]
    finite = torch.cat(errors)
    finite = finite[finite.isfinite()]
    if not finite.numel():
        raise CalibrationDataError(
            f"{dataset.first.path}: outlier_window_mm needs pixels that look at their plane, and "
            "there are none; check the planes in frames.csv and tool_from_camera."
        )
    centre = float(np.median(finite.numpy()))
    # A comparison with NaN is False: pixels without a plane count as outside.
    outside: Mask = lambda batch: ~((raw_error(batch) - centre).abs() <= window_mm / 1e3)  # noqa: E731
    return replace(dataset, exclude=outside)


class MaskOptions(Options):
    """Which pixels are used.

    Attributes:
        outlier_window_mm: Pixels whose raw error (before any fit) is further than this from the
            median raw error are not used; null uses all.
        edge_contrast: Pixels are left out whose 3 x 3 neighbourhood is brighter by this factor at
            one place than at another; null keeps them.
        grazing_deg: Pixels are left out that see the wall at a larger angle from its normal; null
            keeps them.
        mask: `recording`: pixels look at the wall where mask.npy says so, or everywhere without
            it; `ransac`: where they lie on the largest plane of their image.
        mask_tolerance_mm: How far a pixel may lie from that plane.
    """

    outlier_window_mm: PositiveFloat | None = None
    edge_contrast: float | None = Field(default=None, gt=1.0)
    grazing_deg: float | None = Field(default=None, gt=0.0, lt=90.0)
    mask: Literal["recording", "ransac"] = "recording"
    mask_tolerance_mm: PositiveFloat = 30.0


def with_exclusion(dataset: Dataset, exclude: Mask) -> Dataset:
    """Return the data set without further pixels."""
    first = dataset.exclude
    if first is None:
        return replace(dataset, exclude=exclude)
    return replace(dataset, exclude=lambda batch: first(batch) | exclude(batch))


def usable_pixels(
    dataset: Dataset,
    options: MaskOptions,
    *,
    robust: bool,
    frames: Sequence[int] | np.ndarray | None = None,
) -> Dataset:
    """Return the data set without the pixels that the options leave out.

    Args:
        dataset: The recordings.
        options: Which pixels are used.
        robust: Whether the fit uses robust weights. These need a start without gross outliers,
            so pixels far off the plane of most of their image are left out too.
        frames: Global numbers of the frames whose pixels decide where the outlier window lies;
            None: all. Every other mask looks at one image alone.

    Raises:
        CalibrationDataError: `edge_contrast` is set and there are no amplitudes, or no pixel is
            within `outlier_window_mm`; or that is set and the planes are estimated.
    """
    if options.outlier_window_mm is not None and dataset.planes_are_estimated:
        raise CalibrationDataError(
            f"{dataset.first.path}: outlier_window_mm compares with the recorded planes, and these "
            "are estimated from the depth (recording.yaml: planes); use weights.robust or mask: "
            "ransac instead."
        )
    dataset = without_outliers(dataset, options.outlier_window_mm, frames)
    rays = dataset.ray_directions()
    masks: list[Mask] = []
    if options.mask == "ransac":
        masks.append(off_largest_plane(rays, options.mask_tolerance_mm * 1e-3))
    if options.edge_contrast is not None:
        dataset.require("amplitude", "the mask of edges (edge_contrast)")
        masks.append(edges(options.edge_contrast))
    if options.grazing_deg is not None:
        masks.append(grazing(options.grazing_deg, rays))
    if robust:
        masks.append(off_the_wall(rays))
    for mask in masks:
        dataset = with_exclusion(dataset, mask)
    return dataset
