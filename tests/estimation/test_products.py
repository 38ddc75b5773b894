"""The products formed, and those that follow from them, for every kind of error term."""

import pytest
import torch
from cameras import camera
from kinds_of_terms import DOMAIN, built
from synthetic_scene import EA, error_model, frame_batch
from torch import Generator

from tofcorr.data.recording import FrameBatch
from tofcorr.error_terms.model import ErrorModel
from tofcorr.error_terms.registry import TERMS
from tofcorr.estimation.accumulator import Design, MomentAccumulator, moments_of_few, on_polynomials
from tofcorr.geometry.rays import ray_directions

CAMERA = camera((66, 66), (120.0, 125.0), (32.0, 33.0))
DISTANCE = {"kind": "distance_polynomial", "degree": 2}


def design_of(model: ErrorModel) -> Design:
    return Design(model, DOMAIN, ray_directions(CAMERA))


def frames(generator: Generator) -> FrameBatch:
    """Distances and amplitudes of twice the calibrated range; a fifth of the pixels is missing."""
    distance, amplitude, chance = torch.rand(3, 4, 66, 66, generator=generator, dtype=torch.float64)
    valid = chance > 0.2
    distance = torch.where(valid, 0.2 + 6.0 * distance, torch.nan)
    amplitude = torch.where(valid, 5.0 + 1800.0 * amplitude, torch.inf)
    plane = torch.eye(4, 3, dtype=torch.float64), torch.ones(4, dtype=torch.float64)
    return frame_batch(distance, amplitude, *plane, valid)


@pytest.mark.parametrize("with_distance", [True, False])
@pytest.mark.parametrize("kind", TERMS)
def test_moments_are_those_of_the_columns_pixel_by_pixel(
    kind: str, *, with_distance: bool, generator: Generator
) -> None:
    beside = [DISTANCE] if with_distance and kind != DISTANCE["kind"] else []
    design, batch = design_of(built({"kind": kind}, *beside)), frames(generator)
    weights = 0.2 + torch.rand(batch.valid.shape, generator=generator, dtype=torch.float64)
    assert on_polynomials(design)
    for given in (None, weights):
        found = MomentAccumulator(design)(batch, given).gram
        expected = torch.stack([moments_of_few(design, batch, k, given) for k in range(4)])
        size = expected.diagonal(dim1=1, dim2=2).sqrt().clamp(min=1e-9)
        scale = size[:, :, None] * size[:, None]
        # Powers reach some thousands outside the range, and lose their digits with each other.
        assert ((found - expected).abs() / scale).max() < 1e-12


def test_static_images_that_no_polynomials_follow_are_left_as_they_are() -> None:
    model, focal = error_model(EA), 160.0 / 3.73
    design = design_of(model)
    # A step in one row, which no sample of rows need contain.
    design.pixel_functions[1, 2, 33:] += 1.0
    assert not on_polynomials(design)
    # A view of 150 degrees across, whose rays no polynomial that is tried follows to rounding.
    wide = camera((320, 60), (focal, focal), (160.0, 30.0))
    assert not on_polynomials(Design(model, DOMAIN, ray_directions(wide)))


def test_products_with_the_distance_follow_from_those_of_its_polynomial() -> None:
    design = Design(error_model(EA), DOMAIN, ray_directions(CAMERA))
    # u^0..6, a^1..4, and u^1..3 times a and a^2.
    assert len(MomentAccumulator(design).formed) == 7 + 4 + 3 * 2
