"""Where tests of the whole find a gap, an effect need be significant by itself only."""

from types import SimpleNamespace

import pytest
import torch
from diagnosis.comparisons import effect_test, model_of

from tofcorr.diagnosis.findings.effect_comparison import EffectComparison
from tofcorr.diagnosis.findings.gap import name_in_two
from tofcorr.diagnosis.findings.naming import next_effect
from tofcorr.diagnosis.sums.study import Study

GAP = 4e-6  # Two millimetres, squared.


def _comparison(study: Study, closes: float, p_value: float) -> EffectComparison:
    """An effect that closes a share of the gap, among others that reach more by chance."""
    square = GAP * study.sums.count
    noise = study.fit.floor**2 * study.sums.count
    draws = torch.linspace(0.0, 1.0, 99, dtype=torch.float64)
    lens = effect_test("lens", closes * square, gain=1.0 - p_value, null=draws)
    # It often gains more by chance than the lens does, in units of its own spread.
    often = draws.flip(0) ** 40 + draws**40
    motion = effect_test("motion", 0 * square, gain=-1.0, null=often)
    tests = {"lens": lens, "motion": motion}
    return EffectComparison(chosen=(), squares=noise + square, tests=tests, probes={})


@pytest.mark.parametrize(
    ("closes", "p_value", "certain", "named"),
    [
        (0.9, 0.02, False, False),
        (0.9, 0.02, True, True),
        (0.4, 0.02, True, False),  # Less than half of the gap.
        (0.9, 0.20, True, False),  # Not even significant by itself.
    ],
)
def test_a_certain_gap_is_named_by_what_is_significant_alone_and_explains_most_of_it(
    closes: float, p_value: float, certain: bool, named: bool, nothing_study: Study
) -> None:
    compared = _comparison(nothing_study, closes, p_value)
    assert compared.naming_p_value("lens") > 0.05
    found = next_effect(model_of(nothing_study, compared), GAP, certain=certain)
    assert (found is not None) == named


def test_a_second_effect_is_not_named_on_less_evidence(nothing_study: Study) -> None:
    compared = _comparison(nothing_study, 0.9, 0.02)
    model = model_of(nothing_study, compared, names=("warm_up",))
    assert next_effect(model, GAP, certain=True) is None


@pytest.mark.parametrize(
    ("names", "likeliest", "unknown", "again"),
    [
        ((), ("lens",), True, True),
        ((), ("lens",), False, False),  # Nothing says that there is a gap.
        ((), (), True, False),  # No effect would be named.
        (("motion",), ("lens",), True, False),
    ],
)
def test_effects_are_named_again_only_where_none_is_and_a_gap_is_certain(
    names: tuple[str, ...],
    likeliest: tuple[str, ...],
    unknown: bool,
    again: bool,
    nothing_study: Study,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[bool] = []

    def named(_: Study, *, certain: bool = False) -> SimpleNamespace:
        asked.append(certain)
        return SimpleNamespace(names=names, likeliest=likeliest)

    replaced = {
        "name_effects": named,
        "measure_gap": lambda *_: None,
        "judge_remainder": lambda *_: SimpleNamespace(unknown=unknown),
    }
    for name, function in replaced.items():
        monkeypatch.setattr(f"tofcorr.diagnosis.findings.gap.{name}", function)
    name_in_two(nothing_study, torch.ones(1, nothing_study.observations.num_units).double())
    assert asked == ([False, True] if again else [False])
