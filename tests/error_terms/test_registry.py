"""Laws of what every registered kind of term says of itself, and of its state."""

from dataclasses import replace

import pytest
import torch
from kinds_of_terms import DOMAIN, inputs, model_of, randomise
from torch import Generator

from tofcorr.conditions import CONDITIONS
from tofcorr.error_terms.base import SignalTerm
from tofcorr.error_terms.registry import TERMS
from tofcorr.errors import CalibrationDataError, StateError

SIZES = [
    (kind, name)
    for kind, found in TERMS.items()
    for name in ("degree", "harmonics")
    if name in found.model_fields
]
WITHOUT = {
    "amplitude": replace(DOMAIN, amplitude=None, normalised_amplitude=None),
    "modulation_frequency": replace(DOMAIN, modulation_frequency=None),
    **dict.fromkeys(CONDITIONS, replace(DOMAIN, conditions={})),
}


@pytest.mark.parametrize(
    ("kind", "one", "other"),
    [
        ("amplitude_polynomial", {"variable": "amplitude"}, {"variable": "log_amplitude"}),
        ("periodic", {"fundamental": 4}, {"fundamental": 2}),
        ("tensor_spline", {"distance_segments": 4}, {"amplitude_segments": 4}),
        ("residual_network", {"bound_mm": 10.0}, {"bound_mm": 11.0}),
    ],
)
def test_a_state_of_other_functions_is_refused(kind: str, one: dict, other: dict) -> None:
    with pytest.raises(StateError, match="Build it alike"):
        model_of(kind, **one).load_state_dict(model_of(kind, **other).state_dict())


@pytest.mark.parametrize("kind", TERMS)
def test_a_domain_without_what_a_term_needs_is_refused(kind: str) -> None:
    said = {"amplitude": "amplitude.npy", "modulation_frequency": "modulation_frequency_hz"}
    for need in TERMS[kind].needs:
        with pytest.raises(CalibrationDataError, match=said.get(need, need.replace("_", " "))):
            model_of(kind, WITHOUT[need])


@pytest.mark.parametrize("kind", TERMS)
def test_a_term_reads_only_what_it_says_it_needs(kind: str, generator: Generator) -> None:
    model = model_of(kind)
    randomise(model, generator)
    distance, amplitude, conditions = inputs(generator)
    needs = TERMS[kind].needs
    read = [CONDITIONS.index(name) for name in needs if name in CONDITIONS]
    unread = [k for k in range(len(CONDITIONS)) if k not in read]
    changed = conditions.clone()
    changed[:, unread] += 0.7
    strength = amplitude if "amplitude" in needs else amplitude * 1.3
    found = model(distance, strength, changed)
    assert torch.equal(found, model(distance, amplitude, conditions))


@pytest.mark.parametrize(("kind", "name"), SIZES)
def test_a_larger_member_of_a_family_contains_the_smaller(kind: str, name: str) -> None:
    first, second = (model_of(kind, DOMAIN, **{name: size}).terms()[0] for size in (1, 3))
    assert set(first.symbols) < set(second.symbols)
    same = [second.symbols.index(symbol) for symbol in first.symbols]
    given = {
        "signal": inputs(Generator().manual_seed(1))[:2],
        "pixel": (torch.arange(5.0).double(), torch.arange(5.0).double()),
        "condition": inputs(Generator().manual_seed(1))[2:],
    }
    group = first.group if first.group in given else "signal"
    small, large = (one.basis(*given[group]) for one in (first, second))  # type: ignore[attr-defined]
    torch.testing.assert_close(small, large[same], rtol=0, atol=0)


@pytest.mark.parametrize("kind", TERMS)
def test_the_polynomial_of_a_term_is_the_term(kind: str, generator: Generator) -> None:
    model = model_of(kind)
    randomise(model, generator)
    for term in model.signal_terms:
        assert isinstance(term, SignalTerm)
        found = term.polynomial()
        if found is None:
            continue
        distance, amplitude, _ = inputs(generator)
        x = {"distance": distance, "amplitude": amplitude}[found.variable]
        u = (x - found.centre) / found.half_width
        expected = sum(c * u ** (k + 1) for k, c in enumerate(found.coefficients))
        torch.testing.assert_close(term(distance, amplitude), expected)


@pytest.mark.parametrize("kind", TERMS)
def test_options_found_in_data_do_not_change_the_functions(kind: str) -> None:
    options = TERMS[kind](kind=kind)
    assert set(options.found_in_data) <= set(type(options).model_fields)
    assert all(options.is_open(name) for name in options.found_in_data)
    assert not set(options.found_in_data) & set(options.structure())
