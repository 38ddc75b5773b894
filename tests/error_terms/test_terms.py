"""Laws that every error term obeys, and what each one promises of its own."""

import math
from typing import Any

import numpy as np
import pytest
import torch
from kinds_of_terms import built, randomise
from scipy.interpolate import BSpline
from torch import Generator

from tofcorr.conditions import CONDITIONS
from tofcorr.error_terms.base import ConditionTerm, SignalTerm
from tofcorr.error_terms.splines import placed, second_differences, spline_weights
from tofcorr.geometry.rays import unambiguous_range

SIGNAL: list[dict[str, Any]] = [
    {"kind": "distance_polynomial"},
    {"kind": "distance_spline", "segments": 9},
    {"kind": "lookup_table", "segments": 12},
    {"kind": "periodic", "harmonics": 3},
    {"kind": "amplitude_polynomial", "variable": "amplitude"},
    {"kind": "amplitude_polynomial", "variable": "normalised_amplitude"},
    {"kind": "amplitude_polynomial", "variable": "log_amplitude"},
    {"kind": "incident_light"},
    {"kind": "tensor_spline"},
    {"kind": "tensor_spline", "axis": "amplitude"},
]
CONDITION: list[dict[str, Any]] = [
    {"kind": "integration_time", "degree": 2},
    {"kind": "room_temperature"},
    {"kind": "warm_up", "time_constants_s": [1.5, 6.0]},
]


def name_of(term: dict[str, Any]) -> str:
    return "-".join(str(value) for value in term.values())


def only_signal_term(**term: Any) -> SignalTerm:
    """Return the one term of a model that has no other."""
    (one,) = built(term).signal_terms
    assert isinstance(one, SignalTerm)
    return one


def signals(generator: Generator, size: int = 400) -> tuple[torch.Tensor, torch.Tensor]:
    """Draw distances and amplitudes in the domain and around it, the ends included."""
    u = torch.rand(2, size, generator=generator, dtype=torch.float64) * 1.2 - 0.1
    u[:, 0], u[:, 1] = 0.0, 1.0
    return 0.5 + 2.5 * u[0], (10.0 + 890.0 * u[1]).clamp(min=0.0)


@pytest.fixture(params=SIGNAL, ids=name_of)
def signal_term(request: pytest.FixtureRequest) -> SignalTerm:
    return only_signal_term(**request.param)


@pytest.fixture(params=CONDITION, ids=name_of)
def condition_term(request: pytest.FixtureRequest) -> ConditionTerm:
    return built(request.param).condition_terms[0]  # type: ignore[return-value]


def test_signal_term_is_its_coefficients_times_its_basis_scripted_too(
    signal_term: SignalTerm, generator: Generator
) -> None:
    distance, amplitude = signals(generator)
    assert not signal_term(distance, amplitude).any()  # Nothing before training.
    randomise(signal_term, generator)
    expected = signal_term.coefficients @ signal_term.basis(distance, amplitude)
    torch.testing.assert_close(signal_term(distance, amplitude), expected, rtol=1e-12, atol=1e-12)
    scripted = torch.jit.script(signal_term)
    torch.testing.assert_close(scripted(distance, amplitude), signal_term(distance, amplitude))
    nothing = torch.tensor([math.nan], dtype=torch.float64)
    assert signal_term(nothing, nothing).isnan().all()


def test_signal_term_leaves_the_constant_to_the_model(
    signal_term: SignalTerm, generator: Generator
) -> None:
    distance, amplitude = signals(generator, 20_000)
    basis = signal_term.basis(distance, amplitude)
    columns = torch.cat([torch.ones(1, basis.shape[1], dtype=torch.float64), basis])
    values = torch.linalg.svdvals(columns / columns.norm(dim=1, keepdim=True).clamp(min=1e-12))
    assert values.min() > 1e-5


def test_condition_term_is_zero_at_mean_conditions_and_scripts(
    condition_term: ConditionTerm, generator: Generator
) -> None:
    randomise(condition_term, generator)
    mean = torch.full((len(CONDITIONS),), 2.0, dtype=torch.float64)
    assert float(condition_term(mean).detach().abs()) < 1e-15
    some = 1.0 + 3.0 * torch.rand(6, len(CONDITIONS), generator=generator, dtype=torch.float64)
    expected = condition_term.coefficients @ condition_term.basis(some)
    torch.testing.assert_close(condition_term(some), expected)
    torch.testing.assert_close(torch.jit.script(condition_term)(some), expected)


def test_conditions_beyond_the_calibrated_range_are_held_at_its_edge(
    condition_term: ConditionTerm, generator: Generator
) -> None:
    randomise(condition_term, generator)
    edge = torch.full((len(CONDITIONS),), 4.0, dtype=torch.float64)
    torch.testing.assert_close(condition_term(edge + 5.0), condition_term(edge))
    assert condition_term.covers(edge)
    assert not condition_term.covers(edge + 5.0)


@pytest.mark.parametrize("degree", [1, 3])
def test_splines_are_those_of_scipy(degree: int) -> None:
    segments = 6
    knots = np.arange(-degree, segments + degree + 1)
    x = np.linspace(0, segments, 200, endpoint=False)
    first, weights = spline_weights(torch.from_numpy(2 * x / segments - 1), segments, degree)
    size = segments + degree
    found = placed([first + k for k in range(degree + 1)], weights, size)
    expected = BSpline(knots, np.eye(size), degree)(x).T
    np.testing.assert_allclose(found.numpy(), expected, atol=1e-12)


def test_roughness_is_the_integral_of_the_squared_curvature() -> None:
    # f(x) = x^2 on [0, 1] has f'' = 2; cubic spline coefficients of x^2 are quadratic in k.
    for segments in (6, 40):
        size = segments + 3
        greville = (torch.arange(size, dtype=torch.float64) - 1) / segments
        rough = (second_differences(size, segments) @ greville.square()).square().sum()
        assert float(rough) == pytest.approx(4.0 * (segments + 1) / segments)


@pytest.mark.parametrize("term", [SIGNAL[1], SIGNAL[2], SIGNAL[7]], ids=name_of)
def test_only_what_is_straight_over_the_knots_is_free_of_roughness(term: dict[str, Any]) -> None:
    one = only_signal_term(**term)
    rows = one.roughness()
    assert torch.linalg.matrix_rank(rows) == len(one.symbols) - 1
    full = torch.arange(len(one.symbols) + 1, dtype=torch.float64)
    straight = torch.cat([full[: len(full) // 2], full[len(full) // 2 + 1 :]]) - len(full) // 2
    assert float((rows @ straight).abs().max()) < 1e-9


def test_table_interpolates_like_numpy(generator: Generator) -> None:
    table = only_signal_term(kind="lookup_table", segments=4)
    randomise(table, generator)
    entries = np.insert(table.coefficients.detach().numpy(), 2, 0.0)
    distance = torch.linspace(0.3, 3.2, 99, dtype=torch.float64)
    expected = np.interp(distance.numpy(), np.linspace(0.5, 3.0, 5), entries)
    np.testing.assert_allclose(table(distance, distance).detach().numpy(), expected, atol=1e-12)


def test_circular_error_repeats_each_quarter_of_the_unambiguous_range(generator: Generator) -> None:
    term = only_signal_term(kind="periodic", harmonics=2)
    randomise(term, generator)
    distance = torch.linspace(0.1, 5.0, 50, dtype=torch.float64)
    period = unambiguous_range(20e6) / 4
    torch.testing.assert_close(term(distance, distance), term(distance + period, distance))
    assert not torch.equal(term(distance, distance), term(distance + period / 3, distance))
