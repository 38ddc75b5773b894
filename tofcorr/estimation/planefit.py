r"""The plane on which points lie, by their distances along rays: fitted robustly, and searched for.

On the plane g . x = 1 the inverse distance is linear in the ray, :math:`1 / D = g \cdot a`, so that
each fit is a linear one. Its unit normal towards the camera is -g / |g|, the camera's distance from
it 1 / |g|.
"""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from tofcorr.estimation.statistics import robust_weights
from tofcorr.spread import sigma_from_mad


def deviation(
    rays: Float[Tensor, "V 3"], distance: Float[Tensor, "*#B V"], gradient: Float[Tensor, "*B 3"]
) -> Float[Tensor, "*B V"]:
    """Return measured less fitted distance along each ray; infinite where no ray meets the plane.

    Args:
        rays: Unit rays.
        distance: Along them, metres.
        gradient: g of the plane g . x = 1, 1 / m.
    """
    inverse = gradient @ rays.T
    return torch.where(inverse > 0, distance - 1 / inverse, torch.inf)


def fit_plane(
    rays: Float[Tensor, "V 3"],
    distance: Float[Tensor, "B V"],
    valid: Bool[Tensor, "B V"],
    start: Float[Tensor, "B 3"] | None = None,
    tolerance: float = torch.inf,
    steps: int = 15,
) -> Float[Tensor, "B 3"]:
    """Fit a plane to each of B images, reweighted with Cauchy's weights.

    Args:
        rays: Unit rays of V pixels.
        distance: Along them, metres; any number where not valid.
        valid: Which pixels may be used.
        start: Planes to start from; None: all valid pixels weigh the same at first.
        tolerance: Pixels farther from the latest plane are left out, metres.
        steps: How many times it is fitted; the weights have settled after fifteen.

    Returns:
        g of each plane g . x = 1.
    """
    inverse = 1 / torch.where(valid, distance, 1.0)
    # Powers of the distance make a least-squares fit of inverse distances one of distances.
    full = valid * inverse.pow(-4)
    weight = full if start is not None else valid.to(inverse)
    gradient = rays.new_zeros(len(distance), 3) if start is None else start
    for step in range(steps):
        if step or start is not None:
            # Deviations as distances, not as inverse distances: their noise is of one size.
            off = (inverse - gradient @ rays.T) / inverse.square()
            used = valid & (off.abs() <= tolerance)
            typical = torch.where(used, off.abs(), torch.nan).nanmedian(dim=1, keepdim=True).values
            scale = sigma_from_mad(typical.nan_to_num(0.0)).clamp(min=1e-6)
            weight = torch.where(used, full * robust_weights(off / scale, "cauchy"), 0.0)
        matrix = torch.einsum("bv,va,vc->bac", weight, rays, rays)
        right = (weight * inverse) @ rays
        ridge = 1e-12 * torch.eye(3).to(inverse)
        enough = (weight > 0).sum(dim=1) > 2
        found = torch.linalg.solve(matrix + ridge, right[:, :, None])[:, :, 0]
        gradient = torch.where(enough[:, None], found, gradient)
    return gradient


def largest_plane(
    rays: Float[Tensor, "V 3"],
    distance: Float[Tensor, "V"],
    tolerance: float,
    generator: torch.Generator,
    triples: Int[Tensor, "T 3"] | None = None,
) -> Float[Tensor, "3"] | None:
    """Return the plane that most of some pixels lie on (Fischler and Bolles 1981).

    Planes through three pixels are compared by their truncated squared deviations (Torr 2000); the
    best few are fitted to what is near them, and compared again.

    Args:
        rays: Unit rays.
        distance: Along them, metres.
        tolerance: Distance along the ray within which a pixel is on a plane, metres.
        generator: Draws pixels; the same state gives the same plane.
        triples: Places of the three pixels of each plane that is tried; None: 300 are drawn. With a
            third of the pixels on the largest plane, these all miss it with a probability of
            (1 - 1/27)^300 = 1e-5.

    Returns:
        g of the plane g . x = 1; None where no three pixels determine one.
    """
    if triples is None:
        triples = torch.randint(max(len(distance), 1), (300, 3), generator=generator)
        triples = triples[: 0 if len(distance) < 3 else 300]
    matrix = rays[triples]
    sound = torch.linalg.det(matrix).abs() > 1e-6
    if not bool(sound.any()):
        return None
    # As many pixels tell planes apart: the share of one on 5 % of them is then known to a tenth.
    judges = torch.randperm(len(distance), generator=generator)[:2000]

    def cost(tried: Float[Tensor, "T 3"]) -> Float[Tensor, "T"]:
        off = deviation(rays[judges], distance[None, judges], tried)
        return (off / tolerance).square().clamp(max=1.0).sum(dim=1)

    tried = torch.linalg.solve(matrix[sound], 1 / distance[triples[sound]][:, :, None])[:, :, 0]
    best = tried[cost(tried).argsort(stable=True)[:4]]
    every = torch.ones(len(best), len(distance), dtype=torch.bool)
    fitted = fit_plane(rays, distance.expand(len(best), -1), every, best, tolerance, steps=4)
    return fitted[int(cost(fitted).argmin())]
