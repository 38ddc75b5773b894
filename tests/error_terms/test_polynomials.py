"""The polynomial terms of the paper: derivatives, scaling, and the way to and from its symbols."""

import math
from typing import Any

import pytest
import torch

from tofcorr.error_terms.base import Domain, Interval, SignalTerm
from tofcorr.error_terms.model import ErrorModel, ErrorModelOptions

DOMAIN = Domain(
    height=9,
    width=12,
    radial_distance=Interval(0.5, 2.0),
    amplitude=Interval(50.0, 1900.0),
    normalised_amplitude=Interval(60.0, 1500.0),
    modulation_frequency=20e6,
)
D: dict[str, Any] = {"kind": "distance_polynomial"}
P1: dict[str, Any] = {"kind": "pixel_polynomial", "degree": 1}
P2: dict[str, Any] = {"kind": "pixel_polynomial", "degree": 2}
I1: dict[str, Any] = {"kind": "amplitude_polynomial"}
I2: dict[str, Any] = I1 | {"variable": "normalised_amplitude"}
MODELS = {"E0": (D, P1), "EA": (D, P2, I1), "EB": (D, P2, I2), "P3": (D, P2 | {"degree": 3})}
SIGNAL_KINDS: list[dict[str, Any]] = [
    D,
    I1,
    I2,
    I1 | {"variable": "log_amplitude"},
    {"kind": "distance_spline", "segments": 5},
    {"kind": "periodic"},
    {"kind": "incident_light"},
    {"kind": "tensor_spline"},
]


def built(*terms: dict[str, Any]) -> ErrorModel:
    return ErrorModel(ErrorModelOptions.from_mapping({"terms": list(terms)}, "test"), DOMAIN)


def randomised(model: ErrorModel, generator: torch.Generator) -> ErrorModel:
    size = len(model.coefficient_vector())
    model.set_coefficient_vector(torch.randn(size, generator=generator, dtype=torch.float64))
    return model


def frame(generator: torch.Generator) -> tuple[torch.Tensor, torch.Tensor]:
    u = torch.rand(2, 9, 12, generator=generator, dtype=torch.float64)
    return 0.5 + 1.5 * u[0], 50.0 + 1850.0 * u[1]


@pytest.mark.parametrize("kind", SIGNAL_KINDS, ids=lambda kind: "-".join(map(str, kind.values())))
def test_derivatives_of_a_signal_term_are_exact(
    kind: dict[str, Any], generator: torch.Generator
) -> None:
    model = randomised(built(kind), generator)
    u = torch.rand(2, 6, generator=generator, dtype=torch.float64)
    distance = (0.6 + 1.3 * u[0]).requires_grad_()
    # Scaled to a size at which gradcheck's step is small beside every knot and curvature.
    decades = (1.0 + u[1]).requires_grad_()

    term = model.signal_terms[0]
    assert isinstance(term, SignalTerm)

    def error(distance: torch.Tensor, decades: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
        return values @ term.basis(distance, 100.0 * decades)

    values = term.coefficients.detach().clone().requires_grad_()
    assert torch.autograd.gradcheck(error, (distance, decades, values))


@pytest.mark.parametrize("name", MODELS)
def test_coefficients_survive_the_papers_symbols(name: str, generator: torch.Generator) -> None:
    model = randomised(built(*MODELS[name]), generator)
    again = built(*MODELS[name])
    again.set_paper_coefficients(model.paper_coefficients())
    torch.testing.assert_close(
        again.coefficient_vector(), model.coefficient_vector(), rtol=1e-9, atol=1e-9
    )


@pytest.mark.parametrize("name", MODELS)
def test_every_coefficient_of_the_paper_has_a_unit(name: str, generator: torch.Generator) -> None:
    model = randomised(built(*MODELS[name]), generator)
    for values in (model.coefficient_vector(), torch.zeros_like(model.coefficient_vector())):
        model.set_coefficient_vector(values)
        units = {group: set(named) for group, named in model.paper_units().items()}
        assert units == {group: set(named) for group, named in model.paper_coefficients().items()}


def test_ea_in_the_papers_symbols_is_the_papers_formula(generator: torch.Generator) -> None:
    model = built(D, P2, I1)
    c = (0.01, -0.02, 0.015, -0.003)
    p, r0, c0 = (2e-4, -1e-4), 3.3, 7.1
    i = (3e-5, -1e-8)
    model.set_paper_coefficients(
        {
            "distance": {"c0": c[0], "c1": c[1], "c2": c[2], "c3": c[3]},
            "pixel": {"p1": p[0], "p2": p[1], "r0": r0, "c0": c0},
            "intensity": {"i1": i[0], "i2": i[1]},
        }
    )
    distance, amplitude = frame(generator)
    row = torch.arange(9, dtype=torch.float64)[:, None]
    column = torch.arange(12, dtype=torch.float64)
    expected = sum(c[k] * distance**k for k in range(4))
    expected = expected + p[0] * (row - r0) ** 2 + p[1] * (column - c0) ** 2
    expected = expected + i[0] * amplitude + i[1] * amplitude**2
    torch.testing.assert_close(model(distance, amplitude), expected, rtol=0, atol=1e-12)


def test_a_flat_direction_has_its_vertex_nowhere_and_still_survives() -> None:
    model = built(P2)
    model.pixel_terms[0].coefficients.data.copy_(torch.tensor([0.01, 0.0, 0.0, 0.02]))  # type: ignore[union-attr, operator]
    paper = model.paper_coefficients()
    assert math.isnan(paper["pixel"]["r0"])
    again = built(P2)
    again.set_paper_coefficients(paper)
    torch.testing.assert_close(again.coefficient_vector(), model.coefficient_vector())
