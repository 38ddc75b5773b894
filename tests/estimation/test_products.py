"""The products formed, and those that follow from them, for every kind of error term."""

import pytest
import torch
from kinds_of_terms import DOMAIN
from synthetic_scene import EA, error_model

from tofcorr.data.recording import FrameBatch
from tofcorr.error_terms.model import ErrorModel, ErrorModelOptions
from tofcorr.error_terms.registry import TERMS
from tofcorr.estimation.accumulator import Design, MomentAccumulator, moments_of_few
from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.geometry.rays import ray_directions

CAMERA = CameraIntrinsics(
    width=7, height=5, matrix=((6.0, 0.0, 3.2), (0.0, 6.5, 1.8), (0.0, 0.0, 1.0))
)
DISTANCE = {"kind": "distance_polynomial", "degree": 2}


def design_of(model: ErrorModel) -> Design:
    return Design(model, DOMAIN, ray_directions(CAMERA))


def frames(generator: torch.Generator) -> FrameBatch:
    """Distances and amplitudes of twice the calibrated range; a fifth of the pixels is missing."""
    distance, amplitude, chance = torch.rand(3, 4, 5, 7, generator=generator, dtype=torch.float64)
    valid = chance > 0.2
    return FrameBatch(
        indices=torch.arange(4),
        radial_distance=torch.where(valid, 0.2 + 6.0 * distance, torch.nan),
        amplitude=torch.where(valid, 5.0 + 1800.0 * amplitude, torch.inf),
        valid=valid,
        normal_tool=torch.eye(4, 3, dtype=torch.float64),
        offset_tool=torch.ones(4, dtype=torch.float64),
    )


@pytest.mark.parametrize("with_distance", [True, False])
@pytest.mark.parametrize("kind", TERMS)
def test_moments_are_those_of_the_columns_pixel_by_pixel(
    kind: str, *, with_distance: bool, generator: torch.Generator
) -> None:
    terms = [{"kind": kind}]
    if with_distance and kind != DISTANCE["kind"]:
        terms.append(DISTANCE)
    model = ErrorModel(ErrorModelOptions.from_mapping({"terms": terms}, kind), DOMAIN)
    design, batch = design_of(model), frames(generator)
    weights = 0.2 + torch.rand(batch.valid.shape, generator=generator, dtype=torch.float64)
    for given in (None, weights):
        found = MomentAccumulator(design)(batch, given).gram
        expected = torch.stack([moments_of_few(design, batch, k, given) for k in range(4)])
        size = expected.diagonal(dim1=1, dim2=2).sqrt().clamp(min=1e-9)
        scale = size[:, :, None] * size[:, None]
        # Powers reach some thousands outside the range, and lose their digits with each other.
        assert ((found - expected).abs() / scale).max() < 1e-12


def test_products_with_the_distance_follow_from_those_of_its_polynomial() -> None:
    design = Design(error_model(EA), DOMAIN, ray_directions(CAMERA))
    # u^0..6, a^1..4, and u^1..3 times a and a^2.
    assert len(MomentAccumulator(design).formed) == 7 + 4 + 3 * 2
