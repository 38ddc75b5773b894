"""Penalties, their strengths and time constants, from moments alone."""

from dataclasses import replace

import pytest
import torch
from optional import present
from synthetic_scene import CAMERA, DOMAIN, frame_batch
from torch import Generator, Tensor

from tofcorr.data.recording import FrameBatch
from tofcorr.error_terms.base import Domain, SignalTerm
from tofcorr.error_terms.model import ErrorModel, ErrorModelOptions
from tofcorr.estimation.accumulator import Design, MomentAccumulator
from tofcorr.estimation.moments import ImageMoments, MomentObjective, Parameters
from tofcorr.estimation.regularisation import (
    STRENGTHS,
    penalties_of,
    smoothness,
    time_constant,
    total_weight,
    with_strengths,
)
from tofcorr.estimation.solvers import minimise
from tofcorr.geometry.rays import ray_directions

NUM_FRAMES = 24
KNOWN = Parameters(torch.eye(4, dtype=torch.float64), torch.zeros(0), hand_eye_is_free=False)


def frontal_frames(error: Tensor, generator: Generator, noise: float) -> FrameBatch:
    """Return frames of frontal walls, camera known, with an error (B, H, W) in metres."""
    offset = torch.linspace(0.6, 2.2, NUM_FRAMES, dtype=torch.float64)
    normal = torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64).expand(NUM_FRAMES, 3)
    true = offset[:, None, None] / ray_directions(CAMERA)[..., 2]
    random = torch.randn(true.shape, generator=generator, dtype=torch.float64)
    return frame_batch(true + error + noise * random, None, normal, offset)


def spline_model(domain: Domain, strength: object = "auto") -> ErrorModel:
    term = {"kind": "distance_spline", "segments": 20, "strength": strength}
    return ErrorModel(ErrorModelOptions.from_mapping({"terms": [term]}, "test"), domain)


def moments_of(model: ErrorModel, batch: FrameBatch) -> ImageMoments:
    return MomentAccumulator(Design(model, DOMAIN, ray_directions(CAMERA)))(batch)


def zero(moments: ImageMoments) -> Parameters:
    return replace(KNOWN, coefficients=torch.zeros(len(moments.symbols), dtype=torch.float64))


def test_a_penalised_fit_is_least_squares_with_roughness_as_rows(generator: Generator) -> None:
    batch = frontal_frames(torch.zeros(1), generator, 0.01)
    model = spline_model(DOMAIN, 1e-4)

    def fitted(moments: ImageMoments) -> Tensor:
        prior = smoothness(penalties_of(model), total_weight(moments), zero(moments))
        return minimise(MomentObjective(moments, prior), zero(moments)).parameters.coefficients

    moments = moments_of(model, batch)
    found = fitted(moments)
    # The strength means the same for any number of pixels.
    weighted = fitted(moments.weighted(torch.full((NUM_FRAMES,), 7.0).double()))
    torch.testing.assert_close(found, weighted)

    cosine = -ray_directions(CAMERA)[..., 2].expand_as(batch.radial_distance).reshape(-1)
    (spline,) = model.signal_terms
    assert isinstance(spline, SignalTerm)
    basis = spline.basis(batch.radial_distance, batch.radial_distance).flatten(1)
    columns = torch.cat([torch.ones(1, basis.shape[1], dtype=torch.float64), basis])
    offset = batch.offset_tool[:, None, None].expand_as(batch.radial_distance).reshape(-1)
    right = cosine * batch.radial_distance.reshape(-1) + offset
    rows = penalties_of(model)[0].factor * (1e-4 * len(right)) ** 0.5
    stacked = torch.cat([(cosine * columns).T, rows])
    target = torch.cat([right, torch.zeros(len(rows), dtype=torch.float64)])
    expected = torch.linalg.lstsq(stacked, target[:, None], driver="gelsd").solution[:, 0]
    torch.testing.assert_close(found, expected, atol=1e-8, rtol=1e-5)


def test_a_straight_truth_is_smoothed_more_than_a_wavy_one(generator: Generator) -> None:
    folds = [torch.arange(NUM_FRAMES) % 6 == k for k in range(6)]
    true = torch.linspace(0.6, 2.2, NUM_FRAMES, dtype=torch.float64)[:, None, None]
    chosen = {}
    for name, error in (("straight", 0.02 * true), ("wavy", 0.02 * torch.sin(9 * true))):
        model = spline_model(DOMAIN)
        moments = moments_of(model, frontal_frames(error, generator, 0.02))
        (penalty,) = with_strengths(penalties_of(model), moments, zero(moments), folds)
        chosen[name] = float(penalty.strength)
    assert set(chosen.values()) <= set(STRENGTHS)
    assert chosen["straight"] > 10 * chosen["wavy"]


def test_joined_priors_weigh_as_both_alone(generator: Generator) -> None:
    batch = frontal_frames(torch.zeros(1), generator, 0.01)
    model = spline_model(DOMAIN, 1e-3)
    moments = moments_of(model, batch)
    point = zero(moments).moved(torch.randn(len(moments.symbols), generator=generator).double())
    one, other = (
        present(smoothness(penalties_of(model), weight, where))
        for weight, where in ((100.0, zero(moments)), (5.0, point))
    )
    first = replace(one, centre=point, factor=torch.eye(len(point.coefficients)).double())
    here = point.moved(0.3 * torch.ones(len(moments.symbols), dtype=torch.float64))
    both = first.joined(other).equations(here)
    apart = zip(first.equations(here), other.equations(here), strict=True)
    torch.testing.assert_close([*both], [a + b for a, b in apart])


def test_condition_columns_are_what_a_pass_over_the_pixels_would_give(generator: Generator) -> None:
    batch = frontal_frames(torch.zeros(1), generator, 0.01)
    model = ErrorModel(ErrorModelOptions(), DOMAIN)
    numbers = torch.randn(NUM_FRAMES, 1, generator=generator, dtype=torch.float64)
    found = moments_of(model, batch).with_conditions(numbers, ["h1"])
    parameters = replace(KNOWN, coefficients=torch.tensor([0.01, -0.02], dtype=torch.float64))
    error = 0.01 - 0.02 * numbers[:, :, None]
    cosine = -ray_directions(CAMERA)[..., 2]
    residual = cosine * (batch.radial_distance - error) + batch.offset_tool[:, None, None]
    expected = residual.square().sum((1, 2))
    torch.testing.assert_close(MomentObjective(found).image_losses(parameters), expected)


@pytest.mark.parametrize("truth", [20.0, 90.0])
def test_time_constant_of_a_warm_up_is_found(truth: float, generator: Generator) -> None:
    time = torch.linspace(0.0, 300.0, NUM_FRAMES, dtype=torch.float64)
    shuffled = time[torch.randperm(NUM_FRAMES, generator=generator)]
    error = 0.015 * torch.exp(-shuffled / truth)[:, None, None]
    batch = frontal_frames(error, generator, 0.002)
    model = ErrorModel(ErrorModelOptions(), DOMAIN)
    moments = moments_of(model, batch)
    around = minimise(MomentObjective(moments), zero(moments)).parameters
    assert time_constant(moments, around, shuffled) == pytest.approx(truth, rel=0.1)
