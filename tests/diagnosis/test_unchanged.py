"""A parameter of the simulator that need not change has no share: laws on exact toys."""

import pytest
import torch
from torch import Tensor

from tofcorr.diagnosis.findings.attribution import shapley_values
from tofcorr.diagnosis.findings.causes import Cause
from tofcorr.diagnosis.findings.parts import FREE, PREFERRED, READINGS, Parts
from tofcorr.diagnosis.findings.resamples import hull
from tofcorr.diagnosis.findings.unchanged import held_solution, unchanged

_POSES, _PIXELS = 24, 40
_CAUSES = (
    Cause(name="hand_eye", kind="parameter", members=(1,)),
    Cause(name="distance", kind="parameter", members=(0, 2)),
    Cause(name="drift", kind="effect", members=(3,), centred=True),
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
    everything = torch.cat([columns, residual[:, :, None]], dim=2)
    products = everything.transpose(1, 2) @ everything
    counts = torch.full((len(columns),), float(columns.shape[1]), dtype=torch.float64)
    return Parts(
        causes=_CAUSES,
        products=products,
        means=everything.sum(1),
        counts=counts,
        noise=torch.zeros_like(counts),
        start=torch.zeros(columns.shape[2], dtype=torch.float64),
        fitted=(products[:, :-1, :-1], products[:, :-1, -1], 1e-9 * torch.eye(4).double()),
        constant=0,
        least=least * counts,
    )


def _shares(parts: Parts, reading: tuple[bool, bool] = PREFERRED) -> dict[str, float]:
    products, coefficients = parts.refitted(torch.ones(_POSES).double(), type(PREFERRED)(*reading))
    values = shapley_values(products, coefficients)
    names = [cause.name for cause in _CAUSES]
    return dict(zip(names, (values / values.sum()).tolist(), strict=True))


def _truth(columns: Tensor, theta: Tensor) -> dict[str, float]:
    """Return the share of every cause in the square of the sum, from the parts themselves."""
    parts = [(columns[:, :, list(c.members)] @ theta[list(c.members)]).ravel() for c in _CAUSES]
    whole = torch.stack(parts).sum(0)
    return {c.name: float(g @ whole / (whole @ whole)) for c, g in zip(_CAUSES, parts, strict=True)}


@pytest.mark.parametrize("seed", [11, 12, 13])
def test_a_right_hand_eye_transform_takes_nothing_of_a_distance_error(seed: int) -> None:
    columns, noise = _columns(seed)
    theta = torch.tensor([12.0, 0.0, 20.0, 0.0], dtype=torch.float64) * 1e-3
    # An error that no cause models, as an effect's model leaves it, resembles the shift's columns.
    missed = 2e-3 * (columns[:, :, 1] - columns[:, :, 1].mean()) / columns[:, :, 1].std()
    parts = _parts(columns, columns @ theta + 0.1 * missed + 1e-4 * noise, least=(0.3e-3) ** 2)
    true = _truth(columns, theta)
    assert abs(_shares(parts, FREE)["hand_eye"]) > 0.1
    assert _shares(parts)["hand_eye"] == 0.0
    assert _shares(parts)["distance"] == pytest.approx(true["distance"], abs=0.02)


@pytest.mark.parametrize("seed", [21, 22])
def test_a_hand_eye_transform_that_is_wrong_keeps_its_share(seed: int) -> None:
    columns, noise = _columns(seed)
    theta = torch.tensor([0.0, 40.0, 20.0, 0.0], dtype=torch.float64) * 1e-3
    parts = _parts(columns, columns @ theta + 1e-4 * noise, least=(0.3e-3) ** 2)
    assert _shares(parts)["hand_eye"] == pytest.approx(_truth(columns, theta)["hand_eye"], abs=0.02)


@pytest.mark.parametrize("seed", [31, 32])
def test_an_effect_keeps_its_constant_where_the_base_need_not_change(seed: int) -> None:
    columns, noise = _columns(seed)
    theta = torch.tensor([0.0, 0.0, 0.0, 5.0], dtype=torch.float64) * 1e-3
    parts = _parts(columns, columns @ theta + 1e-4 * noise, least=(0.3e-3) ** 2)
    assert _shares(parts) == {"hand_eye": 0.0, "distance": 0.0, "drift": pytest.approx(1.0)}
    assert _shares(parts, FREE)["distance"] > 0.5


def test_readings_differ_where_the_data_leave_the_constant_open() -> None:
    columns, noise = _columns(41)
    theta = torch.tensor([8.0, 0.0, 20.0, 5.0], dtype=torch.float64) * 1e-3
    parts = _parts(columns, columns @ theta + 1e-4 * noise, least=(0.3e-3) ** 2)
    said = [_shares(parts, reading)["drift"] for reading in READINGS]
    true = _truth(columns, theta)["drift"]
    assert min(said) < true - 0.02
    assert max(said) == pytest.approx(true, abs=0.02)


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
    assert unchanged(normal, score, start, groups, 0.0) == frozenset()
    assert unchanged(normal, score, start, groups, 1e9) == set(groups)


def test_a_hull_contains_every_interval() -> None:
    assert hull([(0.1, 0.4), (0.2, 0.7), (0.15, 0.3)]) == (0.1, 0.7)
