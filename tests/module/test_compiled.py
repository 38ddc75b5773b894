"""`torch.compile` takes the module whole, and gives the same values and gradients."""

import pytest
import torch
from kinds_of_terms import KINDS
from module.modules import conditions, frames, module_of, wall_batch, with_missing


def compiled_gradients_agree(backend: str, *kinds: str) -> None:
    # One code for modules of many structures would reach the limit of recompilations.
    torch.compiler.reset()
    module = module_of(*kinds)
    depth, amplitude = frames()
    depth = with_missing(depth)
    compiled = torch.compile(module, fullgraph=True, backend=backend)
    results = []
    for call in (module, compiled):
        module.zero_grad()
        given = depth.clone().requires_grad_()
        strength = amplitude.clone().requires_grad_()
        found = call(given, strength, **conditions((2,)))
        found.nansum().backward()
        own = [p.grad.clone() for p in module.parameters() if p.grad is not None]
        results.append([found.detach(), given.grad, *own])
    eager, other = results
    torch.testing.assert_close(other, eager, rtol=1e-6, atol=1e-9, equal_nan=True)


def test_a_module_of_all_terms_compiles_whole_and_gradients_agree() -> None:
    compiled_gradients_agree("eager", *KINDS)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # The compiler's own dependencies warn of each other.
@pytest.mark.parametrize("backend", ["aot_eager", "inductor"])
@pytest.mark.parametrize("kind", KINDS)
def test_a_module_of_one_term_compiles_whole_and_gradients_agree(kind: str, backend: str) -> None:
    compiled_gradients_agree(backend, kind)


@pytest.mark.slow
def test_the_loss_compiles_with_its_gradient_to_the_hand_eye() -> None:
    module = module_of("distance_polynomial")
    batch = wall_batch(module)
    compiled = torch.compile(module.point_to_plane_loss, fullgraph=True, backend="aot_eager")
    expected = module.point_to_plane_loss(batch)
    (gradient,) = torch.autograd.grad(expected, module.hand_eye.twist)
    (found,) = torch.autograd.grad(compiled(batch), module.hand_eye.twist)
    torch.testing.assert_close(found, gradient, rtol=1e-6, atol=1e-12)
