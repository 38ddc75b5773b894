"""Noise that neighbouring pixels share is no edge of brightness."""

from dataclasses import replace

import pytest
import torch
from optional import present
from simulation.effects.scenes import Scene
from torch import Generator, Tensor

from tofcorr.simulation.effects.base import EffectInputs, blur
from tofcorr.simulation.effects.mixed_pixels import MixedPixelsEffect

FREQUENCY = 200e6  # Phases of neighbours then differ by up to 0.1 rad on tilted targets.
NOISE, DRAWS = 0.02, 24  # of each amplitude; images that are drawn of each pose
ERROR_AT_EDGES = torch.tensor([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0], dtype=torch.float64)


@pytest.fixture(scope="module")
def shaded(at_rest: Scene) -> EffectInputs:
    """A target without a pattern; what is farther away is darker."""
    distances = present(at_rest.inputs.distance_images).double()
    inputs = replace(at_rest.inputs, modulation_frequency=FREQUENCY, distance_images=distances)
    nearest = distances.amin((1, 2), keepdim=True)
    return _lit(inputs, (nearest / distances) ** 2)


def _lit(inputs: EffectInputs, images: Tensor, noise: float | None = None) -> EffectInputs:
    """Return the inputs with other amplitudes, and noise that is a share of each of them."""
    own = images.flatten(1)[inputs.frame, inputs.pixel].double()
    lit = replace(inputs, amplitude=own, amplitude_images=images)
    return replace(lit, amplitude_noise=None if noise is None else noise * own)


def _explained(inputs: EffectInputs, generator: Generator, noise: float | None) -> float:
    """Return the product of errors at edges and noise of the phase, in standard errors."""
    effect = MixedPixelsEffect.for_recording(inputs)
    phase = present(inputs.distance_images) / inputs.metres_per_radian
    products = []
    for _ in range(DRAWS):
        white = torch.randn(*phase.shape, 2, dtype=torch.float64, generator=generator)
        filtered = blur(torch.view_as_complex(white), 1.0)
        filtered = filtered * NOISE / filtered.real.std()
        turned = 1 + filtered * torch.polar(torch.ones_like(phase), -phase)
        seen = _lit(inputs, present(inputs.amplitude_images) * turned.abs(), noise)
        edges = effect.shift(seen, ERROR_AT_EDGES)
        error = turned.angle().flatten(1)[inputs.frame, inputs.pixel]
        sums = torch.zeros(len(phase), dtype=torch.float64)
        products.append(sums.index_add(0, inputs.frame, (edges - edges.mean()) * error))
    each = torch.cat(products)
    return float(each.sum() / each.square().sum().sqrt().clamp(min=1e-12))


def test_filtered_noise_of_distances_is_not_explained_by_that_of_amplitudes(
    shaded: EffectInputs, generator: Generator
) -> None:
    """Mixed pixels were named for 8 % of filtering cameras with nothing missing."""
    assert abs(_explained(shaded, generator, None)) > 3
    assert abs(_explained(shaded, generator, NOISE)) < 2


def test_edges_that_exceed_the_noise_stay(at_rest: Scene) -> None:
    inputs = at_rest.inputs
    effect = MixedPixelsEffect.for_recording(inputs)
    images = present(inputs.amplitude_images)
    seen = [_lit(inputs, images, noise) for noise in (None, NOISE)]
    plain, shared = (effect.shift(one, ERROR_AT_EDGES) for one in seen)
    strong = plain > 0.95
    assert int(strong.sum()) > 100
    torch.testing.assert_close(shared[strong], plain[strong])
