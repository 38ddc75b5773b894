"""Moments say of the loss what the pixels say."""

from dataclasses import replace

import cameras
import pytest
import torch
from synthetic_scene import (
    DOMAIN,
    E0,
    EA,
    EB,
    Scene,
    frame_batch,
    make_scene,
    nearby,
    without_invalid_pixels,
)
from torch import Generator, Tensor

from tofcorr.data.recording import FrameBatch
from tofcorr.error_terms.model import ErrorModel, ErrorModelOptions
from tofcorr.estimation.accumulator import Design, MomentAccumulator
from tofcorr.estimation.moments import MomentObjective, concatenate
from tofcorr.geometry.rays import ray_directions

# Moments sum squared distances of about 1 m^2, of which 1e-5 m^2 a pixel are left as loss: 5 of 16
# digits go, and a few more bits in 1500 additions.
RELATIVE = 1e-10


@pytest.fixture(params=[E0, EA, EB], ids=["E0", "EA", "EB"])
def scene(request: pytest.FixtureRequest, generator: Generator) -> Scene:
    return make_scene(generator, request.param)


@pytest.fixture
def weights(scene: Scene, generator: Generator) -> Tensor:
    return 0.2 + torch.rand(scene.batch.valid.shape, generator=generator, dtype=torch.float64)


def test_the_loss_of_the_moments_is_that_of_the_reference_model(
    scene: Scene, weights: Tensor, generator: Generator
) -> None:
    parameters = nearby(scene.truth, generator)
    used = scene.batch.valid
    expected = (weights * scene.residual(parameters).square())[used].sum()
    found = MomentObjective(scene.moments(weights=weights)).loss(parameters)
    torch.testing.assert_close(found, expected, rtol=RELATIVE, atol=0.0)


def test_gradient_and_hessian_are_those_of_autograd_over_all_pixels(
    scene: Scene, weights: Tensor, generator: Generator
) -> None:
    origin = nearby(scene.truth, generator)
    whole = without_invalid_pixels(scene)
    zero = torch.zeros(origin.size, dtype=torch.float64)
    residual = whole.residual_of_step(origin, zero)[scene.batch.valid]
    jacobian = torch.autograd.functional.jacobian(
        lambda step: whole.residual_of_step(origin, step)[scene.batch.valid], zero
    )
    assert isinstance(jacobian, Tensor)
    weighted = weights[scene.batch.valid][:, None] * jacobian
    objective = MomentObjective(scene.moments(weights=weights))
    found = objective.normal_equations(origin)
    size = (weighted.abs() * residual.abs()[:, None]).sum(dim=0).max()
    gradient, hessian = weighted.T @ residual, weighted.T @ jacobian
    for one, expected, scale in (
        (found.gradient, gradient, size),
        (found.hessian, hessian, hessian.abs().max()),
    ):
        atol = RELATIVE * float(scale)
        torch.testing.assert_close(one, expected, rtol=RELATIVE, atol=atol)


def test_the_sum_of_the_images_has_their_equations(scene: Scene, generator: Generator) -> None:
    objective = MomentObjective(scene.moments())
    parameters = nearby(scene.truth, generator)
    each, found = objective.image_equations(parameters), objective.normal_equations(parameters)
    assert torch.equal(found.loss, each.loss.sum())
    for one, whole in zip(each[1:], found[1:], strict=True):
        size = float(one.abs().sum(0).max())
        # Rounding of sums of a few hundred squared distances, of which the residuals are a part.
        torch.testing.assert_close(whole, one.sum(0), rtol=0.0, atol=1e-11 * size)


def test_pixels_that_are_not_valid_never_enter(scene: Scene) -> None:
    with_nan, without = scene.moments(), without_invalid_pixels(scene).moments()
    assert not scene.batch.valid.all()
    assert scene.batch.radial_distance[~scene.batch.valid].isnan().all()
    assert torch.equal(with_nan.gram, without.gram)
    assert torch.equal(with_nan.count, scene.batch.valid.sum(dim=(1, 2)).double())


def test_a_subset_of_images_has_the_moments_of_these_images_alone(scene: Scene) -> None:
    chosen = [3, 0, 7]
    batch = scene.batch
    parts = {name: part[chosen] for name, part in vars(batch).items() if part is not None}
    expected = MomentAccumulator(scene.design())(FrameBatch(**parts))
    found = scene.moments().images(chosen)
    torch.testing.assert_close(found.gram, expected.gram, rtol=1e-13, atol=1e-13)
    mask = torch.zeros(len(batch.valid), dtype=torch.bool)
    mask[chosen] = True
    assert torch.equal(scene.moments().images(mask).count, expected.count[[1, 0, 2]])


def test_losses_of_disjoint_subsets_add_up_and_weights_count_images(scene: Scene) -> None:
    moments = scene.moments()
    first, second = moments.images([0, 1, 2]), moments.images([3, 4])
    twice = moments.images([0, 1, 2, 3, 4]).weighted(torch.tensor([1.0, 1, 1, 2, 2]).double())
    losses = [MomentObjective(part).loss(scene.truth) for part in (first, second, twice)]
    torch.testing.assert_close(losses[0] + 2 * losses[1], losses[2], rtol=1e-10, atol=0.0)
    joined = MomentObjective(concatenate([first, second, second])).loss(scene.truth)
    torch.testing.assert_close(joined, losses[2], rtol=1e-10, atol=0.0)
    assert twice.count.tolist() == (moments.count[:5] * torch.tensor([1, 1, 1, 2, 2])).tolist()


def test_moments_of_some_columns_are_those_of_the_smaller_model(generator: Generator) -> None:
    scene = make_scene(generator, EA)
    small = scene.moments(E0)
    found = scene.moments().columns(small.symbols)
    torch.testing.assert_close(found.gram, small.gram, rtol=1e-12, atol=1e-12)
    assert found.symbols == small.symbols
    bare = scene.moments().columns([])
    assert bare.gram.shape[-1] == 4
    assert len(bare.symbols) == 0


def test_without_amplitudes_a_model_that_needs_none_is_unaffected(generator: Generator) -> None:
    scene = make_scene(generator, E0)
    blind = replace(scene, batch=replace(scene.batch, amplitude=None))
    assert torch.equal(blind.moments().gram, scene.moments().gram)


def test_images_of_several_blocks_have_the_same_moments(
    monkeypatch: pytest.MonkeyPatch, generator: Generator
) -> None:
    # The rows of every block were once those of the last, which were written over them.
    camera = cameras.camera((320, 100), (250.0, 250.0), (160.0, 50.0))
    domain = replace(DOMAIN, height=camera.height, width=camera.width)
    model = ErrorModel(ErrorModelOptions.from_mapping(EA, "test"), domain)
    design = Design(model, domain, ray_directions(camera))
    shape = (2, camera.height, camera.width)
    random = torch.rand(2, *shape, generator=generator, dtype=torch.float64)
    plane = torch.eye(3, dtype=torch.float64)[:2], torch.ones(2, dtype=torch.float64)
    batch = frame_batch(0.6 + random[0], 100 + 900 * random[1], *plane)
    found = MomentAccumulator(design)(batch)
    monkeypatch.setattr(MomentAccumulator, "few_pixels", 2.0)
    expected = MomentAccumulator(design)(batch)
    torch.testing.assert_close(found.gram, expected.gram, rtol=1e-12, atol=1e-9)
