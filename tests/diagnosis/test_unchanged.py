"""A parameter of the simulator that need not change has no share: laws on exact toys."""

import pytest
import torch
from torch import Tensor

from tofcorr.diagnosis.findings.shares import Parts, Share, held_solution, hidden_shares, unchanged

_POSES, _PIXELS = 24, 40
_CAUSES = (
    Share(cause="hand_eye", kind="parameter", members=(1,)),
    Share(cause="distance", kind="parameter", members=(0, 2)),
    Share(cause="drift", kind="effect", members=(3,)),
)


def _columns(seed: int) -> tuple[Tensor, Tensor]:
    """Return a constant, a shift along the axis, a slope and a drift, (U, M, 4), and noise."""
    generator = torch.Generator().manual_seed(seed)
    tilt = 0.15 * torch.rand(_POSES, _PIXELS, generator=generator, dtype=torch.float64)
    distance = torch.rand(_POSES, _PIXELS, generator=generator, dtype=torch.float64)
    time = torch.linspace(0, 1, _POSES, dtype=torch.float64)[:, None].expand(_POSES, _PIXELS)
    ones = torch.ones_like(tilt)
    noise = torch.randn(_POSES, _PIXELS, generator=generator, dtype=torch.float64)
    return torch.stack([ones, 1 - tilt, distance, 0.5 + time], dim=2), noise


def _parts(columns: Tensor, residual: Tensor, least: float) -> Parts:
    """Return the parts of a residual (U, M); `least`, m^2, is what a change must close."""
    beside = torch.stack([residual, torch.ones_like(residual)], dim=2)
    everything = torch.cat([columns, beside], dim=2)
    products = everything.transpose(1, 2) @ everything
    counts = products[:, -1, -1]
    return Parts(
        causes=_CAUSES,
        products=products,
        noise=torch.zeros_like(counts),
        start=torch.zeros(columns.shape[2], dtype=torch.float64),
        fitted=(products[:, :-2, :-2], products[:, :-2, -2], 1e-9 * torch.eye(4).double()),
        prior=1e-9 * torch.eye(4).double(),
        constant=0,
        least=dict.fromkeys(("hand_eye", "distance"), least * counts),
    )


def _shares(parts: Parts, *, sparse: bool = True) -> dict[str, float]:
    found = parts.refitted(torch.ones(_POSES).double(), sparse=sparse)
    values = found.values
    names = [cause.cause for cause in _CAUSES]
    return dict(zip(names, (values / values.sum()).tolist(), strict=True))


def _truth(columns: Tensor, theta: Tensor) -> dict[str, float]:
    """Return the share of every cause in the square of the sum; means count as distance."""
    parts = {
        c.cause: (columns[:, :, list(c.members)] @ theta[list(c.members)]).ravel() for c in _CAUSES
    }
    constant = sum(float(part.mean()) for part in parts.values())
    parts = {name: part - part.mean() for name, part in parts.items()}
    parts["distance"] = parts["distance"] + constant
    whole = torch.stack(list(parts.values())).sum(0)
    return {name: float(part @ whole / (whole @ whole)) for name, part in parts.items()}


@pytest.mark.parametrize("seed", [11, 12, 13])
def test_a_right_hand_eye_transform_takes_nothing_of_a_distance_error(seed: int) -> None:
    columns, noise = _columns(seed)
    theta = torch.tensor([12.0, 0.0, 20.0, 0.0], dtype=torch.float64) * 1e-3
    # An error that no cause models, as an effect's model leaves it, resembles the shift's columns.
    missed = 2e-3 * (columns[:, :, 1] - columns[:, :, 1].mean()) / columns[:, :, 1].std()
    parts = _parts(columns, columns @ theta + 0.1 * missed + 1e-4 * noise, least=(0.3e-3) ** 2)
    true = _truth(columns, theta)
    assert _shares(parts)["hand_eye"] == 0.0
    assert _shares(parts)["distance"] == pytest.approx(true["distance"], abs=0.02)


@pytest.mark.parametrize("seed", [21, 22])
def test_a_hand_eye_transform_that_is_wrong_keeps_its_share(seed: int) -> None:
    columns, noise = _columns(seed)
    theta = torch.tensor([0.0, 40.0, 20.0, 0.0], dtype=torch.float64) * 1e-3
    parts = _parts(columns, columns @ theta + 1e-4 * noise, least=(0.3e-3) ** 2)
    assert _shares(parts)["hand_eye"] == pytest.approx(_truth(columns, theta)["hand_eye"], abs=0.02)


@pytest.mark.parametrize("theta", [(0, 0, 0, 5), (8, 0, 20, 5), (-8, 40, 0, 5)])
def test_a_constant_counts_as_distance_whichever_cause_has_it(theta: tuple[float, ...]) -> None:
    columns, noise = _columns(31)
    true = _truth(columns, torch.tensor(theta, dtype=torch.float64))
    response = columns @ (1e-3 * torch.tensor(theta, dtype=torch.float64))
    parts = _parts(columns, response + 1e-4 * noise, least=(0.1e-3) ** 2)
    for sparse in (True, False):
        assert _shares(parts, sparse=sparse) == pytest.approx(true, abs=0.02)


def test_moving_a_constant_from_one_cause_to_another_changes_no_share() -> None:
    columns, noise = _columns(41)
    theta = torch.tensor([8.0, 0.0, 20.0, 5.0], dtype=torch.float64) * 1e-3
    moved = columns.clone()
    moved[:, :, 3] += 4.0  # The same drift, counted from another start.
    response = columns @ theta + 1e-4 * noise
    found = [_shares(_parts(one, response, least=1e-8)) for one in (columns, moved)]
    assert found[0] == pytest.approx(found[1], abs=1e-6)


def test_nothing_is_hidden_where_nothing_is_left_and_more_where_more_is() -> None:
    columns, _ = _columns(71)
    parts = _parts(columns, columns @ torch.tensor([8.0, 5.0, 20.0, 5.0]).double(), least=1e-8)
    refitted = parts.refitted(torch.ones(_POSES).double())
    assert hidden_shares(parts, refitted, 0.0) == [0.0, 0.0, 0.0]
    little, much = (torch.tensor(hidden_shares(parts, refitted, left)) for left in (0.01, 0.04))
    assert torch.allclose(2 * little, much)
    # No cause of the simulator's own reaches more of the residual than all causes together.
    assert float(much[:2].max()) <= float(much[2]) + 1e-12
    assert float(much[2]) < 1.96 * (0.04 / 4) ** 0.5 + 1e-12


def test_a_held_solution_is_the_least_squares_fit_of_the_other_columns() -> None:
    columns, noise = _columns(51)
    flat, response = columns.reshape(-1, 4), noise.ravel()
    start = torch.tensor([1.0, -2.0, 0.5, 0.3], dtype=torch.float64)
    # Around the base fit the residual is what the start leaves.
    score = flat.T @ (response - flat @ start)
    found = held_solution(flat.T @ flat, score, start, [1, 3])
    expected = torch.linalg.lstsq(flat[:, [0, 2]], response[:, None]).solution[:, 0]
    assert torch.allclose(found[[0, 2]], expected)
    assert found[[1, 3]].tolist() == [0.0, 0.0]


def test_nothing_stays_unchanged_if_nothing_need_be_closed() -> None:
    columns, noise = _columns(61)
    flat = columns.reshape(-1, 4)
    normal, score, start = flat.T @ flat, flat.T @ noise.ravel(), torch.zeros(4).double()
    groups = {"hand_eye": (1,), "distance": (0, 2)}
    assert unchanged(normal, score, start, groups, dict.fromkeys(groups, 1e-12)) == frozenset()
    assert unchanged(normal, score, start, groups, dict.fromkeys(groups, 1e9)) == set(groups)


def test_each_parameter_has_a_threshold_of_its_own() -> None:
    columns, noise = _columns(62)
    theta = torch.tensor([5.0, 0.0, 20.0, 0.0], dtype=torch.float64)
    flat = columns.reshape(-1, 4)
    normal, score = flat.T @ flat, flat.T @ (flat @ theta + noise.ravel())
    groups = {"hand_eye": (1,), "distance": (0, 2)}
    least = {"hand_eye": 1e3, "distance": 1e-12}
    assert unchanged(normal, score, torch.zeros(4).double(), groups, least) == {"hand_eye"}
