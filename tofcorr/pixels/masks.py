"""Which pixels are used: masks against outliers, other surfaces, edges and grazing incidence."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from pydantic import Field, PositiveFloat
from torch import Tensor

from tofcorr.data.frames import FrameBatch
from tofcorr.errors import CalibrationDataError
from tofcorr.estimation.statistics import robust_weights
from tofcorr.geometry.planes import ray_plane_distance
from tofcorr.options import Options
from tofcorr.pixels.dataset import Dataset, recorded_hand_eye
from tofcorr.pixels.sample import some_pixels
from tofcorr.spread import sigma_from_mad

# Reweighting steps of the robust fit; it has settled by then. Set by hand.
_ITERATIONS = 15
# A pixel is not on the wall if it is off by more than this many times the image's median deviation
# and by more than 50 mm: a camera's own error varies by centimetres across an image. Set by hand.
_GROSS = 15.0
_GROSS_METRES = 0.05
# Pixels of an image that its plane is fitted to where a mask only compares with it: their noise
# leaves a tenth of a millimetre, and a mask's tolerance is of centimetres. Chosen.
ENOUGH_FOR_MASKS = 4096


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
    distance: Float[Tensor, "B V"], valid: Bool[Tensor, "B V"], rays: Float[Tensor, "V 3"]
) -> Float[Tensor, "B 3"]:
    """Return g of 1 / D = g . ray of each image, fitted robustly to its valid pixels."""
    inverse = 1 / distance
    weight = valid.to(inverse)
    gradient = rays.new_zeros(len(distance), 3)
    ridge = 1e-12 * torch.eye(3).to(inverse)
    for _ in range(_ITERATIONS):
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


@dataclass(frozen=True)
class OffTheWall:
    """Finds pixels far off the plane of most of their image.

    Attributes:
        ray_directions: Unit rays, shape (H, W, 3).
        tolerance: Largest deviation of a pixel on the wall, metres; None: fifteen times the
            image's median deviation, but at least 50 mm.
    """

    ray_directions: Float[Tensor, "H W 3"]
    tolerance: float | None = None

    def __call__(self, batch: FrameBatch) -> Bool[Tensor, "B H W"]:
        """Return True where a pixel is not on the wall, shape (B, H, W)."""
        deviation = image_planes(batch, self.ray_directions, ENOUGH_FOR_MASKS).deviation.abs()
        if self.tolerance is not None:
            return ~(deviation <= self.tolerance)
        median = deviation.flatten(1).nanmedian(dim=1).values
        limit = (_GROSS * median).clamp(min=_GROSS_METRES)
        return ~(deviation <= limit[:, None, None])


# Triples of pixels drawn in each image. With a third of the pixels on the wall, 300 triples all
# miss it with probability (1 - 1/27)^300 = 1e-5.
_TRIPLES = 300
# Pixels of the image, at most, on which the planes of the triples are compared. Set by hand.
_JUDGES = 2000
# Fits of a plane to the pixels near the previous one. Set by hand.
_REFINEMENTS = 3


@dataclass(frozen=True)
class NotOnLargestPlane:
    """Finds pixels that are not on the largest plane of their image (Fischler and Bolles 1981).

    The same image always gives the same result: the frame's number seeds the random triples.

    Attributes:
        ray_directions: Unit rays, shape (H, W, 3).
        tolerance: How far a pixel's distance may be from the plane's, metres. It must leave room
            for the camera's error across the image, which is what is to be calibrated.
    """

    ray_directions: Float[Tensor, "H W 3"]
    tolerance: float

    def __call__(self, batch: FrameBatch) -> Bool[Tensor, "B H W"]:
        """Return True where a pixel is not on the wall, shape (B, H, W)."""
        rays = self.ray_directions.to(batch.radial_distance)
        near = torch.zeros_like(batch.valid)
        for k, frame in enumerate(batch.indices.tolist()):
            near[k] = self._near(batch.radial_distance[k], batch.valid[k], rays, frame)
        # The camera's error bends the measured wall: a plane fitted to much of it is better
        # than that of three pixels.
        for _ in range(_REFINEMENTS):
            planes = image_planes(replace(batch, valid=near), rays, ENOUGH_FOR_MASKS)
            fitted = -planes.offset[:, None, None] / torch.einsum(
                "hwa,ba->bhw", rays, planes.normal
            )
            near = batch.valid & ((batch.radial_distance - fitted).abs() <= self.tolerance)
        return ~near

    def _near(
        self,
        distance: Float[Tensor, "H W"],
        valid: Bool[Tensor, "H W"],
        rays: Float[Tensor, "H W 3"],
        frame: int,
    ) -> Bool[Tensor, "H W"]:
        """Return the pixels near the best triple's plane: the one with most pixels near it."""
        usable = valid.flatten().nonzero()[:, 0]
        if len(usable) < 3:
            return torch.zeros_like(valid)
        generator = torch.Generator().manual_seed(frame)
        judges = usable[torch.randperm(len(usable), generator=generator)[:_JUDGES].to(usable)]
        drawn = torch.randint(len(usable), (_TRIPLES, 3), generator=generator).to(usable)
        flat_rays, flat = rays.flatten(0, 1), distance.flatten()
        points = flat_rays[usable[drawn]] * flat[usable[drawn], None]
        normal = torch.linalg.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])
        length = normal.norm(dim=1, keepdim=True)
        normal = normal / length.clamp(min=1e-12)
        offset = (normal * points[:, 0]).sum(dim=1)
        met = offset[:, None] / (normal @ flat_rays[judges].T)
        votes = ((met - flat[judges]).abs() <= self.tolerance).sum(dim=1)
        votes[length[:, 0] < 1e-9] = 0
        best = int(votes.argmax())
        met = offset[best] / (rays @ normal[best])
        return valid & ((met - distance).abs() <= self.tolerance)


# The median is taken over a regular sample of about this many pixels. Set by hand.
_MEDIAN_PIXELS = 2_000_000


@dataclass(frozen=True)
class OutlierWindow:
    """The interval of raw errors in which pixels are used.

    The raw error is measured minus true distance along the ray, the true one from the target's
    plane under the recorded hand-eye transform.

    Attributes:
        centre: Median raw error of all usable pixels, metres.
        half_width: Largest distance of a raw error from the median, metres.
        tool_from_camera: The recorded hand-eye transform, shape (4, 4).
        ray_directions: Unit rays in the camera frame, shape (H, W, 3).
    """

    centre: float
    half_width: float
    tool_from_camera: Float[Tensor, "4 4"]
    ray_directions: Float[Tensor, "H W 3"]

    def raw_error(self, batch: FrameBatch) -> Float[Tensor, "B H W"]:
        """Return raw errors, shape (B, H, W), metres; NaN where a ray meets no plane."""
        transform = self.tool_from_camera.to(batch.normal_tool)
        normal = batch.normal_tool @ transform[:3, :3]
        offset = batch.normal_tool @ transform[:3, 3] + batch.offset_tool
        rays = self.ray_directions.to(batch.radial_distance)
        return batch.radial_distance - ray_plane_distance(rays, normal, offset)

    def __call__(self, batch: FrameBatch) -> Bool[Tensor, "B H W"]:
        """Return True where a pixel lies outside the window, shape (B, H, W)."""
        # A comparison with NaN is False: pixels without a plane count as outside.
        return ~((self.raw_error(batch) - self.centre).abs() <= self.half_width)


def without_outliers(
    dataset: Dataset, window_mm: float | None, frames: Sequence[int] | np.ndarray | None = None
) -> Dataset:
    """Return the data set with every pixel left out whose raw error is off by more than a window.

    Args:
        dataset: The recordings.
        window_mm: Largest distance from the median raw error, millimetres; None keeps all.
        frames: Global numbers of the frames that the median is taken over; None: all.

    Raises:
        CalibrationDataError: No usable pixel looks at its plane.
    """
    if window_mm is None:
        return dataset
    camera = dataset.first.camera
    window = OutlierWindow(
        0.0, window_mm / 1e3, recorded_hand_eye(dataset), dataset.ray_directions()
    )
    num_frames = dataset.num_frames if frames is None else len(frames)
    step = -(-num_frames * camera.height * camera.width // _MEDIAN_PIXELS)
    errors = [
        window.raw_error(batch)[batch.valid & batch.radial_distance.isfinite()][::step]
        for batch in dataset.batches(frames)
    ]
    finite = torch.cat(errors)
    finite = finite[finite.isfinite()]
    if not finite.numel():
        raise CalibrationDataError(
            f"{dataset.first.path}: outlier_window_mm needs pixels that look at their plane, and "
            "there are none; check the planes in frames.csv and tool_from_camera."
        )
    return replace(dataset, exclude=replace(window, centre=float(np.median(finite.numpy()))))


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


@dataclass(frozen=True)
class Edges:
    """Finds pixels next to an edge of reflectivity, which mix the light of two surfaces.

    Attributes:
        contrast: Brightest over darkest pixel of a 3 x 3 neighbourhood from which it is an edge.
    """

    contrast: float

    def __call__(self, batch: FrameBatch) -> Bool[Tensor, "B H W"]:
        """Return True on edges, shape (B, H, W); nowhere without amplitudes."""
        if batch.amplitude is None:
            return torch.zeros_like(batch.valid)
        usable = batch.valid
        pool = torch.nn.functional.max_pool2d
        high = torch.where(usable, batch.amplitude, 0.0)
        low = torch.where(usable, batch.amplitude, torch.inf)
        brightest = pool(high[:, None], 3, stride=1, padding=1)[:, 0]
        darkest = -pool(-low[:, None], 3, stride=1, padding=1)[:, 0]
        return brightest > self.contrast * darkest


@dataclass(frozen=True)
class Grazing:
    """Finds pixels that see the wall too obliquely: multipath and lateral errors are large there.

    The wall's direction is fitted to the measured points; no hand-eye transform is needed.

    Attributes:
        limit_deg: Largest angle between the ray and the wall's normal, degrees.
        ray_directions: Unit rays, shape (H, W, 3).
    """

    limit_deg: float
    ray_directions: Float[Tensor, "H W 3"]

    def __call__(self, batch: FrameBatch) -> Bool[Tensor, "B H W"]:
        """Return True where the incidence is too grazing, shape (B, H, W)."""
        rays = self.ray_directions.to(batch.radial_distance)
        normal = image_planes(batch, rays, ENOUGH_FOR_MASKS).normal
        cosine = torch.einsum("hwa,ba->bhw", rays, normal).abs()
        return cosine < math.cos(math.radians(self.limit_deg))


def with_exclusion(
    dataset: Dataset, exclude: Callable[[FrameBatch], Bool[Tensor, "B H W"]]
) -> Dataset:
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
        masks.append(NotOnLargestPlane(rays, options.mask_tolerance_mm * 1e-3))
    if options.edge_contrast is not None:
        dataset.require("amplitude", "the mask of edges (edge_contrast)")
        masks.append(Edges(options.edge_contrast))
    if options.grazing_deg is not None:
        masks.append(Grazing(options.grazing_deg, rays))
    if robust:
        masks.append(OffTheWall(rays))
    for mask in masks:
        dataset = with_exclusion(dataset, mask)
    return dataset
