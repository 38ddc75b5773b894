"""The module is differentiable, and torch's transformations agree with it."""

import copy
import pickle
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from kinds_of_terms import KINDS
from module.modules import conditions, frames, module_of, wall_batch, with_missing
from optional import present
from torch.func import functional_call, stack_module_state, vmap

from tofcorr.module.depth_correction import DepthCorrection


@pytest.mark.parametrize("depth_kind", ["radial", "z"])
@pytest.mark.parametrize("kind", KINDS)
def test_gradients_are_exact_in_depth_amplitude_and_parameters(kind: str, depth_kind: str) -> None:
    module = module_of(kind, depth_kind=depth_kind)
    names = [name for name, _ in module.named_parameters()]
    depth, amplitude = (frame[..., :, :] for frame in frames(()))
    given = conditions()

    def corrected(
        depth: torch.Tensor, decades: torch.Tensor, *values: torch.Tensor
    ) -> torch.Tensor:
        # Amplitudes of a size at which the step of gradcheck is small beside every knot.
        parameters = dict(zip(names, values, strict=True))
        points = _Points(module)
        inputs = (depth, 100.0 * decades, given)
        return functional_call(points, {f"module.{k}": v for k, v in parameters.items()}, inputs)

    values = [parameter.detach().clone().requires_grad_() for parameter in module.parameters()]
    inputs = (depth.requires_grad_(), (amplitude / 100.0).requires_grad_(), *values)
    assert torch.autograd.gradcheck(corrected, inputs, fast_mode=True)


class _Points(torch.nn.Module):
    """The points in the tool frame: an output that depends on the hand-eye transform, too."""

    def __init__(self, module: DepthCorrection) -> None:
        super().__init__()
        self.module = module

    def forward(self, depth: torch.Tensor, amplitude: torch.Tensor, given: dict) -> torch.Tensor:
        return self.module.points_tool(depth, amplitude, **given)


def test_every_parameter_receives_a_gradient(module: DepthCorrection) -> None:
    # Every function of a spline needs a pixel somewhere on its pieces.
    u = torch.rand(2, 60, 5, 7, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    depth, amplitude = 0.5 + 2.5 * u[0], 10.0 + 890.0 * u[1]
    module.points_tool(depth, amplitude, **conditions((60,))).square().sum().backward()
    for name, parameter in module.named_parameters():
        assert parameter.grad is not None, name
        assert bool((parameter.grad != 0).all()), name


def test_missing_returns_have_no_gradient_and_spoil_no_other(module: DepthCorrection) -> None:
    depth, amplitude = frames()
    weights = torch.linspace(0.5, 1.5, 35).reshape(5, 7).clone()
    weights[0, :5] = 0.0
    grads = []
    for frame in (depth, with_missing(depth)):
        module.zero_grad()
        given = frame.detach().clone().requires_grad_()
        strength = amplitude.clone().requires_grad_()
        found = module(given, strength, **conditions((2,)))
        torch.where(weights > 0, found, 0.0).mul(weights).sum().backward()
        own = [p.grad.clone() for p in module.parameters() if p.grad is not None]
        grads.append([given.grad, *own])
        assert all(bool(grad.isfinite().all()) for grad in grads[-1])
        if strength.grad is not None:
            assert bool(strength.grad.isfinite().all())
    clean, spoilt = grads
    torch.testing.assert_close(spoilt, clean)
    assert not spoilt[0][..., 0, :5].any()
    # Also where the result itself, NaN included, is summed.
    given = with_missing(depth).requires_grad_()
    (gradient,) = torch.autograd.grad(module(given, amplitude).nansum(), given)
    assert bool(gradient.isfinite().all())
    (gradient,) = torch.autograd.grad(module(given, amplitude).sum(), given)
    assert not gradient[..., 0, :5].any()


def test_copies_and_pickles_are_equal_and_apart(module: DepthCorrection, tmp_path: Path) -> None:
    depth, amplitude = frames()
    expected = module(depth, amplitude).detach()
    torch.save(module, tmp_path / "module")
    loaded = torch.load(tmp_path / "module", weights_only=False)
    copies = copy.deepcopy(module), pickle.loads(pickle.dumps(module)), loaded
    with torch.no_grad():
        module.error_model.constant.add_(1.0)
    for one in copies:
        assert torch.equal(one(depth, amplitude), expected)
        assert one.labels() == module.labels()


def test_vmap_over_frames_and_over_parameters_agrees_with_a_loop(module: DepthCorrection) -> None:
    depth, amplitude = frames((3,))
    found = vmap(module)(depth, amplitude)
    torch.testing.assert_close(found, module(depth, amplitude), rtol=0, atol=1e-14)
    other = copy.deepcopy(module)
    with torch.no_grad():
        for parameter in other.parameters():
            parameter.mul_(1.7)
    parameters, buffers = stack_module_state([module, other])

    def call(parameters: dict, buffers: dict) -> torch.Tensor:
        return functional_call(module, (parameters, buffers), (depth, amplitude))

    both = vmap(call)(parameters, buffers)
    expected = torch.stack([one(depth, amplitude) for one in (module, other)])
    torch.testing.assert_close(both, expected, rtol=0, atol=1e-13)


def test_vmap_over_hand_eyes_agrees_with_a_loop() -> None:
    module = module_of("distance_polynomial")
    depth, _ = frames(())
    twists = torch.randn(4, 6, generator=torch.Generator().manual_seed(2)).double()

    def points(twist: torch.Tensor) -> torch.Tensor:
        given = {"module.hand_eye.twist": twist}
        return functional_call(_Points(module), given, (depth, depth, {}))

    torch.testing.assert_close(vmap(points)(twists), torch.stack([*map(points, twists)]))


def test_the_loss_is_the_mean_squared_distance_to_the_planes(module: DepthCorrection) -> None:
    batch = wall_batch(module)
    times, exposures, degrees, _, light = present(batch.conditions).unbind(1)
    given = {"timestamp_s": times, "integration_time_us": 1e6 * exposures}
    given |= {"room_temperature_c": degrees, "ambient": light}
    points = module.points_tool(batch.radial_distance, batch.amplitude, **given)
    distance = (points * batch.normal_tool[:, None, None]).sum(-1)
    distance = distance + batch.offset_tool[:, None, None]
    expected = distance[batch.valid].square().mean()
    torch.testing.assert_close(module.point_to_plane_loss(batch), expected)


def test_unknown_conditions_count_as_the_mean_of_the_calibration() -> None:
    module = module_of("room_temperature")
    batch = wall_batch(module)
    unknown = torch.full((3, 5), torch.nan, dtype=torch.float64)
    mean = module.ranges.mean_conditions.expand(3, -1)
    found = module.point_to_plane_loss(replace(batch, conditions=unknown))
    expected = module.point_to_plane_loss(replace(batch, conditions=mean))
    torch.testing.assert_close(found, expected)
    depth, _ = frames()
    assert torch.equal(module(depth, room_temperature_c=torch.nan), module(depth))
