"""The polynomial terms of the paper: derivatives, scaling, and the way to and from its symbols."""

import math
from typing import Any

import pytest
import torch
from kinds_of_terms import built, inputs, randomise
from torch import Generator

D: dict[str, Any] = {"kind": "distance_polynomial"}
P1: dict[str, Any] = {"kind": "pixel_polynomial", "degree": 1}
P2: dict[str, Any] = {"kind": "pixel_polynomial", "degree": 2}
I1: dict[str, Any] = {"kind": "amplitude_polynomial"}
I2: dict[str, Any] = I1 | {"variable": "normalised_amplitude"}
MODELS = {"E0": (D, P1), "EA": (D, P2, I1), "EB": (D, P2, I2), "P3": (D, P2 | {"degree": 3})}


@pytest.mark.parametrize("name", MODELS)
def test_coefficients_survive_the_papers_symbols(name: str, generator: Generator) -> None:
    model = built(*MODELS[name])
    randomise(model, generator)
    again = built(*MODELS[name])
    again.set_paper_coefficients(model.paper_coefficients())
    found, expected = (one.coefficient_vector() for one in (again, model))
    torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-9)


def test_ea_in_the_papers_symbols_is_the_papers_formula(generator: Generator) -> None:
    model = built(D, P2, I1)
    c, i = (0.01, -0.02, 0.015, -0.003), (3e-5, -1e-8)
    p, r0, c0 = (2e-4, -1e-4), 3.3, 7.1
    values = {"distance": {f"c{k}": one for k, one in enumerate(c)}}
    values["pixel"] = {"p1": p[0], "p2": p[1], "r0": r0, "c0": c0}
    values["intensity"] = {"i1": i[0], "i2": i[1]}
    model.set_paper_coefficients(values)
    distance, amplitude, _ = inputs(generator)
    row = torch.arange(5, dtype=torch.float64)[:, None]
    column = torch.arange(7, dtype=torch.float64)
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
