"""A sample of pixels with all that their distance to the plane depends on."""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
import torch
from torch import Tensor

from tofcorr.error_terms.model import ErrorModel, Pixels
from tofcorr.estimation.parameters import Parameters
from tofcorr.pixels.dataset import Dataset


@dataclass(frozen=True)
class ResidualSample:
    """Pixels of some frames, the same number from each that has as many.

    Attributes:
        image: Which of the frames, counted from 0, shape (M,), int64.
        pixels: Distance, amplitude, place and conditions.
        rays: Unit rays in the camera frame, shape (M, 3).
        normal_tool: Normals of their planes, shape (M, 3).
        offset_tool: Offsets of their planes, shape (M,), metres.
    """

    image: Tensor
    pixels: Pixels
    rays: Tensor
    normal_tool: Tensor
    offset_tool: Tensor

    def of(self, images: Tensor) -> "ResidualSample":
        """Return the pixels of some images, given as a mask over all images."""
        chosen = images[self.image]
        rest = {
            field.name: getattr(self, field.name)[chosen]
            for field in fields(self)
            if field.name != "pixels"
        }
        return ResidualSample(pixels=Pixels(*(values[chosen] for values in self.pixels)), **rest)

    def distance_to_plane(self, parameters: Parameters, error: Tensor) -> Tensor:
        """Return the signed distance (M,) of points corrected by an error (M,), metres."""
        transform = parameters.tool_from_camera
        cosine = self.cosine(parameters)
        offset = self.normal_tool @ transform[:3, 3] + self.offset_tool
        return cosine * (self.pixels.radial_distance - error) + offset

    def cosine(self, parameters: Parameters) -> Tensor:
        """Return the cosine between ray and normal, shape (M,)."""
        normal = self.normal_tool @ parameters.tool_from_camera[:3, :3]
        return (normal * self.rays).sum(-1)


def sample_for_residual(
    dataset: Dataset, frames: Sequence[int] | np.ndarray, num_pixels: int, seed: int
) -> ResidualSample:
    """Draw pixels at random, the same ones every time.

    Args:
        dataset: The recordings.
        frames: Global numbers of the frames, in increasing order.
        num_pixels: About how many of all frames together.
        seed: Of the choice.
    """
    generator = torch.Generator().manual_seed(seed)
    per_frame = max(num_pixels // max(len(frames), 1), 1)
    rays = dataset.ray_directions().reshape(-1, 3)
    width = dataset.first.camera.width
    image_of = {int(frame): k for k, frame in enumerate(frames)}
    drawn: list[tuple[Tensor, ...]] = []
    for batch in dataset.batches(frames):
        amplitude = batch.radial_distance if batch.amplitude is None else batch.amplitude
        assert batch.conditions is not None
        for k, frame in enumerate(batch.indices.tolist()):
            usable = batch.valid[k].reshape(-1).nonzero()[:, 0]
            order = torch.randperm(len(usable), generator=generator)[:per_frame]
            place = usable[order]
            drawn.append(
                (
                    torch.full_like(place, image_of[frame]),
                    batch.radial_distance[k].reshape(-1)[place],
                    amplitude[k].reshape(-1)[place],
                    (place // width).double(),
                    (place % width).double(),
                    batch.conditions[k].expand(len(place), -1),
                    rays[place],
                    batch.normal_tool[k].expand(len(place), 3),
                    batch.offset_tool[k].expand(len(place)),
                )
            )
    image, distance, strength, rows, columns, conditions, ray, normal, offset = (
        torch.cat(column) for column in zip(*drawn, strict=True)
    )
    pixels = Pixels(distance, strength, rows, columns, conditions)
    return ResidualSample(image, pixels, ray, normal, offset)


def core_error(model: ErrorModel, sample: ResidualSample, coefficients: Tensor) -> Tensor:
    """Return what terms and fixed pattern predict at the sample, shape (M,), metres."""
    with torch.no_grad():
        columns = model.columns_at(sample.pixels)
        return coefficients @ columns + model.pattern_at(sample.pixels)
