"""Moments of an image of which few pixels are used, from those pixels alone."""

import torch
from jaxtyping import Float
from torch import Tensor

from tofcorr.estimation.design import Design
from tofcorr.estimation.images import Images

# Used pixels whose products are formed at once: they stay in the processor's cache. Set by timing.
_BLOCK_PIXELS = 8_192


def moments_of_few(
    design: Design, batch: Images, frame: int, weights: Float[Tensor, "B H W"] | None = None
) -> Float[Tensor, "S S"]:
    """Return the Gram matrix of one image, as `MomentAccumulator` does, pixel by used pixel.

    The factored pass costs the same however many pixels are used; this one costs (3C + 1)^2 a used
    pixel. A target that fills a small part of the image is quicker this way.

    Args:
        design: The columns.
        batch: Some images.
        frame: Which one of them.
        weights: Weights of the pixels, shape (B, H, W); 1 each if None.

    Returns:
        Shape (S, S) with S = 3C + 1.
    """
    valid = batch.valid[frame]
    size = 3 * design.num_columns + 1
    gram = torch.zeros(size, size, dtype=torch.float64, device=valid.device)
    for rows, columns in zip(
        *(index.split(_BLOCK_PIXELS) for index in torch.nonzero(valid, as_tuple=True)), strict=True
    ):
        distance = batch.radial_distance[frame, rows, columns].double()
        amplitude = distance
        if batch.amplitude is not None:
            amplitude = batch.amplitude[frame, rows, columns].double()
        signal = design.signal_functions(distance, amplitude)[design.signal]
        column = signal * design.pixel_functions[:, rows, columns][design.pixel]
        rays = design.ray_directions[rows, columns].T.to(column)
        products = (column[:, None] * rays).flatten(0, 1)
        products = torch.cat([products, torch.ones_like(distance)[None].to(products)])
        weighted = products
        if weights is not None:
            weighted = products * weights[frame, rows, columns]
        gram += weighted @ products.T
    return gram
