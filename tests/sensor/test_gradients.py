"""Gradients of what a sensor measures, by finite differences."""

import pytest
import torch
from sensor.sensors import CONDITIONS, EFFECTS, ERROR, NOISE, entries, plane_scene, sensor
from torch import Tensor
from torch.func import functional_call

from tofcorr.sensor.model import SensorModel

# Effects with a few coefficients; maps and the heat of a warm-up have dozens.
SMALL = [name for name in EFFECTS if name not in ("fixed_pattern", "row_column_pattern", "warm_up")]


def check(model: SensorModel, names: list[str], of_scene: bool) -> None:
    depth, amplitude, _ = plane_scene()
    scene = [value.clone().requires_grad_(of_scene) for value in (depth, amplitude)]
    own = dict(model.named_parameters())

    def measured(depth: Tensor, amplitude: Tensor, *values: Tensor) -> Tensor:
        generator = torch.Generator().manual_seed(4)
        named = dict(zip(names, values, strict=True))
        given = {"generator": generator, **CONDITIONS}
        return functional_call(model, named, (depth, amplitude), given).depth[2:10:3, 3:14:5]

    values = [own[name].detach().clone().requires_grad_() for name in names]
    assert torch.autograd.gradcheck(measured, (*scene, *values), atol=1e-6, rtol=1e-4)


def test_gradients_of_terms_and_noise_are_exact_in_parameters_depth_and_amplitude() -> None:
    model = sensor(error=ERROR | {"reads": "measured_distance"}, noise=NOISE)
    names = [name for name, _ in model.named_parameters()]
    assert len(names) == 5
    check(model, names, of_scene=True)


@pytest.mark.parametrize("name", SMALL)
def test_the_gradient_of_an_effects_coefficients_is_exact(name: str) -> None:
    model = sensor(effects=entries(name))
    check(model, ["base.model.constant", "effects.coefficients.0"], of_scene=False)


def test_every_parameter_gets_a_gradient() -> None:
    model = sensor(error=ERROR, effects=entries(*EFFECTS), noise=NOISE)
    depth, amplitude, _ = plane_scene()
    generator = torch.Generator().manual_seed(2)
    measured = model(depth, amplitude, generator=generator, **CONDITIONS)
    measured.depth.square().sum().backward()
    for name, parameter in model.named_parameters():
        assert parameter.grad is not None, name
        assert bool(parameter.grad.isfinite().all()), name
        assert bool((parameter.grad != 0).any()), name
