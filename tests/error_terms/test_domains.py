"""A model on other ranges: the same error with other coefficients."""

from dataclasses import replace

import pytest
import torch

from tofcorr.error_terms.base import Domain, Interval
from tofcorr.error_terms.model import ErrorModel, ErrorModelOptions, columns_on
from tofcorr.errors import CalibrationDataError

NEAR = Domain(
    height=6,
    width=8,
    radial_distance=Interval(0.5, 1.5),
    amplitude=Interval(50.0, 900.0),
    normalised_amplitude=Interval(100.0, 700.0),
    modulation_frequency=2e7,
    conditions={"integration_time": (1e-4, 5e-4, 2e-4), "timestamp": (0.0, 60.0, 25.0)},
)
FAR = replace(
    NEAR,
    radial_distance=Interval(1.2, 4.0),
    amplitude=Interval(20.0, 400.0),
    normalised_amplitude=Interval(150.0, 900.0),
    conditions={"integration_time": (2e-4, 9e-4, 4e-4), "timestamp": (0.0, 90.0, 45.0)},
)
TERMS = [
    {"kind": "distance_polynomial", "degree": 4},
    {"kind": "periodic"},
    {"kind": "pixel_polynomial", "degree": 2},
    {"kind": "amplitude_polynomial", "variable": "normalised_amplitude", "degree": 2},
    {"kind": "amplitude_polynomial", "variable": "log_amplitude", "degree": 1},
    {"kind": "integration_time", "degree": 2},
    {"kind": "warm_up", "time_constants_s": [20.0]},
]


def options_of(*terms: dict) -> ErrorModelOptions:
    return ErrorModelOptions.model_validate({"terms": terms})


def test_moved_coefficients_give_the_same_error() -> None:
    options = options_of(*TERMS)
    near, far = ErrorModel(options, NEAR), ErrorModel(options, FAR)
    coefficients = torch.linspace(-0.03, 0.02, near.coefficient_vector().numel()).double()
    near.set_coefficient_vector(coefficients)
    far.set_coefficient_vector(columns_on(options, NEAR, FAR).T @ coefficients)
    distance = torch.linspace(1.2, 1.5, 48, dtype=torch.float64).view(6, 8)
    amplitude = torch.linspace(300.0, 70.0, 48, dtype=torch.float64).view(6, 8)
    conditions = torch.tensor(NEAR.mean_conditions(), dtype=torch.float64) * 1.5
    with torch.no_grad():
        one, other = (each(distance, amplitude, conditions) for each in (near, far))
    assert torch.allclose(one, other, rtol=0, atol=1e-12)


def test_there_and_back_is_the_identity() -> None:
    options = options_of(*TERMS)
    both = columns_on(options, NEAR, FAR) @ columns_on(options, FAR, NEAR)
    assert torch.allclose(both, torch.eye(len(both), dtype=torch.float64), atol=1e-9)


def test_splines_of_other_knots_are_refused() -> None:
    options = options_of({"kind": "distance_spline"})
    same = columns_on(options, NEAR, NEAR)
    assert torch.allclose(same, torch.eye(len(same), dtype=torch.float64), atol=1e-9)
    with pytest.raises(CalibrationDataError, match="depend on the range"):
        columns_on(options, NEAR, FAR)


def test_joined_ranges_hold_both() -> None:
    both = NEAR.joined(FAR)
    assert both == FAR.joined(NEAR)
    assert both.radial_distance == (0.5, 4.0)
    assert both.conditions["timestamp"] == (0.0, 90.0, 35.0)
    with pytest.raises(CalibrationDataError, match="height"):
        NEAR.joined(replace(FAR, height=7))
