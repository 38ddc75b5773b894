"""Sums of products give what the whole covariance matrix gives, and variances are found again."""

import pytest
import torch
from torch import Tensor

from tofcorr.estimation.linear import Classes, GroupSums, estimate, inverse, reduced


def drawn(
    groups: int, size: int, spread: tuple[float, float], noise: float, seed: int
) -> tuple[GroupSums, list[tuple[Tensor, Tensor, Tensor]]]:
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    truth, data = torch.tensor([1.0, -2.0, 0.5]).double(), []
    for _ in range(groups):
        x, effects = normal(size, 3), normal(size, 2)
        own = normal(2) * torch.tensor(spread).double()
        data.append((x, effects, x @ truth + effects @ own + noise * normal(size)))
    columns = [torch.cat([x, n, y[:, None]], dim=1) for x, n, y in data]
    products = torch.stack([own.T @ own for own in columns])
    return GroupSums(products, torch.full((groups,), float(size)).double(), 2), data


def test_integrating_effects_out_is_generalised_least_squares() -> None:
    sums, data = drawn(4, 12, (0.7, 0.2), 0.3, seed=1)
    noise, random = torch.full((4,), 0.09).double(), torch.tensor([0.49, 0.04]).double()
    precision, right = reduced(sums, noise, 1 / random)
    for k, (x, effects, y) in enumerate(data):
        covariance = 0.09 * torch.eye(12) + effects @ torch.diag(random) @ effects.T
        weight = torch.linalg.inv(covariance)
        torch.testing.assert_close(precision[k], x.T @ weight @ x, rtol=1e-8, atol=1e-8)
        torch.testing.assert_close(right[k], x.T @ weight @ y, rtol=1e-8, atol=1e-8)


def test_an_unknown_effect_is_projected_out() -> None:
    sums, data = drawn(1, 12, (100.0, 100.0), 0.3, seed=2)
    precision, _ = reduced(sums, torch.ones(1).double(), torch.zeros(2).double())
    x, effects, _ = data[0]
    q = torch.linalg.qr(effects).Q
    outside = x - q @ (q.T @ x)
    torch.testing.assert_close(precision[0], outside.T @ outside, rtol=1e-8, atol=1e-8)


def test_the_variances_are_found_again() -> None:
    sums, _ = drawn(400, 20, (0.035, 0.01), 0.015, seed=3)
    of = Classes(
        of_random=torch.tensor([0, 1]),
        of_unknown=torch.full((3,), -1),
        believed_random=torch.full((2,), 2.5e-5).double(),
        believed_unknown=torch.ones(1).double(),
    )
    found = estimate(sums, torch.zeros(3, 3).double(), of)
    # A standard deviation of 400 effects is known to 3.5 %; four of these.
    assert found.variances.random.sqrt().tolist() == pytest.approx([0.035, 0.01], rel=0.15)
    assert found.variances.noise**0.5 == pytest.approx(0.015, rel=0.05)
    error = found.mean - torch.tensor([1.0, -2.0, 0.5]).double()
    assert bool((error.abs() < 4 * found.covariance.diagonal().sqrt()).all())


def test_the_inverse_does_not_mind_units() -> None:
    scale = torch.tensor([1e-6, 1.0, 1e8]).double()
    matrix = torch.tensor([[2.0, 0.3, 0.1], [0.3, 1.0, 0.2], [0.1, 0.2, 3.0]]).double()
    scaled = matrix * scale[:, None] * scale[None, :]
    identity = inverse(scaled) @ scaled * scale[:, None] / scale[None, :]
    torch.testing.assert_close(identity, torch.eye(3).double(), rtol=0, atol=1e-6)
