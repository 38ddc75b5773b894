"""Gradients of what a sensor measures, by finite differences."""

import pytest
import torch
from sensor.sensors import ERROR, NOISE, plane_scene, sensor_file
from sensor.test_forward import CONDITIONS, EFFECTS
from torch import Tensor
from torch.func import functional_call

from tofcorr.sensor.model import SensorModel

# Effects with a few coefficients; maps and the heat of a warm-up have dozens.
SMALL = [name for name in EFFECTS if name not in ("fixed_pattern", "row_column_pattern", "warm_up")]


def check(model: SensorModel, names: list[str], of_scene: bool) -> None:
    depth, amplitude, _ = plane_scene()
    scene = [value[:, :].clone().requires_grad_(of_scene) for value in (depth, amplitude)]
    given = dict(model.named_parameters())

    def measured(depth: Tensor, amplitude: Tensor, *values: Tensor) -> Tensor:
        generator = torch.Generator().manual_seed(4)
        named = dict(zip(names, values, strict=True))
        return functional_call(
            model, named, (depth, amplitude), {"generator": generator, **CONDITIONS}
        ).depth[2:10:3, 3:14:5]

    values = [given[name].detach().clone().requires_grad_() for name in names]
    assert torch.autograd.gradcheck(
        measured, (*scene, *values), eps=1e-6, atol=1e-6, rtol=1e-4, nondet_tol=0
    )


def test_gradients_of_terms_and_noise_are_exact_in_parameters_depth_and_amplitude() -> None:
    model = SensorModel(
        sensor_file(error=ERROR | {"reads": "measured_distance"}, noise=NOISE), torch.float64
    )
    names = [name for name, _ in model.named_parameters()]
    assert len(names) == 5
    check(model, names, of_scene=True)


@pytest.mark.parametrize("name", SMALL)
def test_the_gradient_of_an_effects_coefficients_is_exact(name: str) -> None:
    effects = [{"name": name, **EFFECTS[name]}]
    model = SensorModel(sensor_file(effects=effects), torch.float64)
    check(model, ["base.model.constant", "effects.effects.0.coefficients"], of_scene=False)


def test_every_parameter_gets_a_gradient() -> None:
    effects = [{"name": name, **EFFECTS[name]} for name in EFFECTS]
    model = SensorModel(sensor_file(error=ERROR, effects=effects, noise=NOISE))
    depth, amplitude, _ = plane_scene()
    generator = torch.Generator().manual_seed(2)
    measured = model(depth.float(), amplitude.float(), generator=generator, **CONDITIONS)
    measured.depth.square().sum().backward()
    for name, parameter in model.named_parameters():
        assert parameter.grad is not None, name
        assert bool(parameter.grad.isfinite().all()), name
        assert bool((parameter.grad != 0).any()), name
