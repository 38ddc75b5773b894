"""Which pixels of a data set are used, and some of them: their errors and their noise."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np
import torch
from jaxtyping import Int
from pydantic import Field, PositiveFloat
from torch import Tensor

from tofcorr.correction.model import CalibrationModel
from tofcorr.data.recording import FrameBatch
from tofcorr.error_terms.model import Pixels
from tofcorr.errors import CalibrationDataError
from tofcorr.geometry.rays import Images, Rays
from tofcorr.options import Options
from tofcorr.pixels.dataset import Dataset, Frames, recorded_hand_eye
from tofcorr.pixels.masks import edges, grazing, off_largest_plane, off_the_wall, raw_errors


def pixels_of_image(batch: FrameBatch, k: int, chosen: Int[Tensor, "M"]) -> Pixels:
    """Return some pixels of image k of a batch.

    Args:
        batch: The images, with their conditions.
        k: Which of them.
        chosen: Numbers of the pixels, counted row by row, shape (M,).

    Returns:
        The pixels, M of them. Without recorded amplitudes their amplitude is meaningless.
    """
    assert batch.conditions is not None
    width = batch.valid.shape[2]
    distance = batch.radial_distance[k].reshape(-1)[chosen]
    amplitude = distance if batch.amplitude is None else batch.amplitude[k].reshape(-1)[chosen]
    rows, columns = (chosen // width).to(distance), (chosen % width).to(distance)
    return Pixels(distance, amplitude, rows, columns, batch.conditions[k].expand(len(chosen), -1))


@dataclass(frozen=True)
class FramePixels:
    """Pixels of some frames with all that their distance to the plane depends on.

    It is the form in which pixels go through a computation that takes a few of every frame: names
    and units are those of `FrameBatch`, one row a pixel.

    Attributes:
        frame: Which of the frames, counted from 0, shape (M,), int64.
        pixels: Distance, amplitude, place and conditions, as an error model takes them.
        ray: Unit rays in the camera frame, shape (M, 3).
        normal_tool: Normals of their planes, shape (M, 3).
        offset_tool: Offsets of their planes, shape (M,), metres.
    """

    frame: Tensor
    pixels: Pixels
    ray: Tensor
    normal_tool: Tensor
    offset_tool: Tensor

    def of(self, chosen: Tensor) -> "FramePixels":
        """Return some of the pixels, given as a mask (M,)."""
        pixels = Pixels(*(values[chosen] for values in self.pixels))
        rest = self.ray[chosen], self.normal_tool[chosen], self.offset_tool[chosen]
        return FramePixels(self.frame[chosen], pixels, *rest)

    def distance_to_plane(self, tool_from_camera: Tensor, error: Tensor) -> Tensor:
        """Return the signed distance (M,) of points corrected by an error (M,), metres."""
        offset = self.normal_tool @ tool_from_camera[:3, 3] + self.offset_tool
        return self.cosine(tool_from_camera) * (self.pixels.radial_distance - error) + offset

    def cosine(self, tool_from_camera: Tensor) -> Tensor:
        """Return the cosine between ray and normal, shape (M,)."""
        return ((self.normal_tool @ tool_from_camera[:3, :3]) * self.ray).sum(-1)


def draw_pixels(dataset: Dataset, frames: Frames, number: int, seed: int) -> FramePixels:
    """Draw pixels at random, the same ones every time, as many from each frame that has so many.

    Args:
        dataset: The recordings.
        frames: Global numbers of the frames, in increasing order.
        number: About how many of all frames together.
        seed: Of the choice.
    """
    generator = torch.Generator().manual_seed(seed)
    per_frame = max(number // max(len(frames), 1), 1)
    rays = dataset.ray_directions().flatten(0, 1)
    place_of = {int(frame): k for k, frame in enumerate(frames)}
    drawn: list[tuple[Tensor, ...]] = []
    for batch in dataset.batches(frames):
        for k, frame in enumerate(batch.indices.tolist()):
            usable = batch.valid[k].flatten().nonzero()[:, 0]
            chosen = usable[torch.randperm(len(usable), generator=generator)[:per_frame]]
            count, own = len(chosen), torch.full_like(chosen, place_of[frame])
            plane = batch.normal_tool[k].expand(count, 3), batch.offset_tool[k].expand(count)
            drawn.append((own, rays[chosen], *plane, *pixels_of_image(batch, k, chosen)))
    own, ray, normal, offset, *pixels = (torch.cat(column) for column in zip(*drawn, strict=True))
    return FramePixels(own, Pixels(*pixels), ray, normal, offset)


def distance_to_plane(
    model: CalibrationModel, batch: FrameBatch, ray_directions: Rays
) -> tuple[Images, Images]:
    """Return the signed distance of every corrected point to its plane, and the cosine of its ray.

    Pixels that are not valid are read as 1 m and amplitude 1, so that no NaN reaches the model.

    Args:
        model: Corrects the distances; its parameters get no gradient.
        batch: The frames.
        ray_directions: Unit rays in the camera frame, shape (H, W, 3).

    Returns:
        Distances, shape (B, H, W), metres, positive on the normal's side, meaningless where not
        valid; and the cosine between ray and normal, shape (B, H, W), negative in front of a plane.
    """
    distance = torch.where(batch.valid, batch.radial_distance, 1.0)
    amplitude = batch.amplitude
    if amplitude is not None:
        amplitude = torch.where(batch.valid, amplitude, 1.0)
    planes = batch.normal_tool, batch.offset_tool
    with torch.no_grad():
        found = model.residual(distance, amplitude, ray_directions, *planes, batch.conditions)
        normal = batch.normal_tool @ model.hand_eye()[:3, :3]
    return found, (ray_directions @ normal.T).permute(2, 0, 1)


class PixelSample:
    """Usable pixels of some frames, drawn at random, and their errors; always the same ones.

    Args:
        dataset: The recordings.
        stages: The models whose errors are wanted; the last one's hand-eye defines incidence.
        frames: Global numbers of the frames; of long recordings only some frames, evenly spread,
            are read.

    Attributes:
        frame: Global number of each pixel's frame, shape (M,).
        covariates: What errors are drawn against, by axis label, each (M,).
        errors_mm: Measured minus true distance along the ray at each stage, each (M,).
    """

    def __init__(
        self, dataset: Dataset, stages: Mapping[str, CalibrationModel], frames: Frames
    ) -> None:
        camera = dataset.first.camera
        # Of four million pixels, which bounds the time, enough for narrow bins.
        read = thinned(np.asarray(frames), max(4_000_000 // (camera.height * camera.width), 1))
        drawn = draw_pixels(dataset, read, 300_000, seed=0)
        covariates = {
            "distance [m]": drawn.pixels.radial_distance,
            "row [pixel]": drawn.pixels.rows,
            "column [pixel]": drawn.pixels.columns,
        }
        if dataset.has_amplitude:
            covariates["amplitude [camera's units]"] = drawn.pixels.amplitude
        self.errors_mm: dict[str, np.ndarray] = {}
        for name, model in stages.items():
            hand_eye = model.hand_eye().detach()
            off, cosine = model.error.error_at(drawn.pixels), drawn.cosine(hand_eye)
            error = 1e3 * drawn.distance_to_plane(hand_eye, off) / cosine
            self.errors_mm[name] = error.numpy()
            angle = torch.rad2deg(torch.acos(cosine.abs().clamp(max=1.0)))
            covariates["angle of incidence [degrees]"] = angle
        self.covariates = {name: one.double().numpy() for name, one in covariates.items()}
        self.frame = read[drawn.frame.numpy()]

    def covariate_named(self, name: str) -> str:
        """Return the axis label of a covariate from its name without unit.

        Raises:
            CalibrationDataError: There is no such covariate.
        """
        labels = {label.split(" [")[0]: label for label in self.covariates}
        if name not in labels:
            has = f"this recording has: {', '.join(labels)}"
            raise CalibrationDataError(f"There is no covariate '{name}' to draw against; {has}.")
        return labels[name]


def thinned(values: np.ndarray, most: int) -> np.ndarray:
    """Return at most `most` of the values, evenly spread over their order."""
    if len(values) <= most:
        return values
    return values[np.linspace(0, len(values) - 1, most).round().astype(int)]


def errors_along_ray(
    dataset: Dataset, model: CalibrationModel, batch: FrameBatch
) -> tuple[Images, Images]:
    """Return measured minus true distance in mm (B, H, W), NaN where not valid, and cosines."""
    rays = dataset.ray_directions().to(batch.radial_distance)
    residual, cosine = distance_to_plane(model, batch, rays)
    return torch.where(batch.valid, 1e3 * residual / cosine, torch.nan), cosine


def _within_window(dataset: Dataset, half_width: float, frames: Frames | None) -> Dataset:
    """Return the data set without pixels whose raw error is off by more than a window, or unknown.

    Mixed pixels at edges, reflections and misplaced masks are off by decimetres; the errors to be
    calibrated are centimetres. In a squared loss a few such pixels would outweigh all others. The
    raw error is measured minus true distance along the ray, the true one from the target's plane
    under the recorded hand-eye transform.

    Args:
        dataset: The recordings.
        half_width: Largest distance from the median raw error, metres.
        frames: Global numbers of the frames that the median is taken over; None: all.

    Raises:
        CalibrationDataError: No usable pixel looks at its plane.
    """
    transform, rays = recorded_hand_eye(dataset), dataset.ray_directions()
    num_frames = dataset.num_frames if frames is None else len(frames)
    # Two million pixels, evenly spread, give the median.
    step = -(-num_frames * rays[..., 0].numel() // 2_000_000)
    errors = [
        raw_errors(batch, rays, transform)[batch.valid & batch.radial_distance.isfinite()][::step]
        for batch in dataset.batches(frames)
    ]
    finite = torch.cat([own[own.isfinite()] for own in errors])
    if not finite.numel():
        said = "outlier_window_mm needs pixels that look at their plane, and there are none"
        advice = "check the planes in frames.csv and tool_from_camera"
        raise CalibrationDataError(f"{dataset.first.path}: {said}; {advice}.")
    centre = float(np.median(finite.numpy()))
    # A comparison with NaN is False: pixels without a plane count as outside.
    return dataset.without(
        lambda batch: ~((raw_errors(batch, rays, transform) - centre).abs() <= half_width)
    )


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


def usable_pixels(
    dataset: Dataset, options: MaskOptions, *, robust: bool, frames: Frames | None = None
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
    rays = dataset.ray_directions()
    if options.outlier_window_mm is not None:
        if dataset.planes_are_estimated:
            said = "outlier_window_mm compares with the recorded planes, which are estimated"
            advice = "use weights.robust or mask: ransac instead"
            raise CalibrationDataError(f"{dataset.first.path}: {said}; {advice}.")
        dataset = _within_window(dataset, options.outlier_window_mm / 1000, frames)
    if options.mask == "ransac":
        tolerance = options.mask_tolerance_mm / 1000
        dataset = dataset.without(partial(off_largest_plane, rays=rays, tolerance=tolerance))
    if options.edge_contrast is not None:
        dataset.require("amplitude", "the mask of edges (edge_contrast)")
        dataset = dataset.without(partial(edges, contrast=options.edge_contrast))
    if options.grazing_deg is not None:
        dataset = dataset.without(partial(grazing, limit_deg=options.grazing_deg, rays=rays))
    return dataset.without(partial(off_the_wall, rays=rays)) if robust else dataset
