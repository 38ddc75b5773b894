"""Some pixels of one image, in the form that an error model takes."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from tofcorr.data.frames import FrameBatch
from tofcorr.error_terms.model import ErrorModel, Pixels


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


def some_pixels(used: Int[Tensor, "M"], most: int, seed: int) -> Int[Tensor, "S"]:
    """Return at most so many of an image's pixels, drawn at random, always the same for a seed."""
    if len(used) <= most:
        return used
    generator = torch.Generator().manual_seed(seed)
    return used[torch.randperm(len(used), generator=generator)[:most]]


@torch.no_grad()
def error_at(error: ErrorModel, pixels: Pixels) -> Float[Tensor, "M"]:
    """Return the error that a model predicts at some pixels, shape (M,), metres along the ray."""
    predicted = error.coefficient_vector() @ error.columns_at(pixels)
    return predicted + error.pattern_at(pixels) + error.residual_at(pixels)
