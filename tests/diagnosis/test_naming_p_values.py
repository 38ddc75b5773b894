"""The p-value of a name: how often chance would name something."""

import pytest
import torch
from diagnosis.comparisons import effect_test
from torch import Tensor

from tofcorr.diagnosis.findings.effect_comparison import EffectComparison, EffectTest

DRAWS = 999


def _test(name: str, gain: float, closed: float, null_closed: Tensor) -> EffectTest:
    generator = torch.Generator().manual_seed(sum(map(ord, name)))
    null = torch.randn(DRAWS, generator=generator, dtype=torch.float64)
    total = torch.tensor([closed], dtype=torch.float64)
    return effect_test(name, total, gain=gain, null=null, null_closed=null_closed)


def _beside(tests: dict[str, EffectTest], least: float = 0.5) -> EffectComparison:
    one = torch.ones(1).double()
    return EffectComparison(chosen=(), squares=one, tests=tests, probes={}, least=least)


def _comparison(closed: float, share: float) -> EffectComparison:
    """Ten effects; in a share of the draws each closes 1, in the others nothing."""
    generator = torch.Generator().manual_seed(1)
    tests = {}
    for number in range(10):
        enough = torch.rand(DRAWS, generator=generator, dtype=torch.float64) < share
        tests[f"effect {number}"] = _test(f"effect {number}", 2.0, closed, enough.double())
    return _beside(tests)


@pytest.mark.parametrize("share", [1.0, 0.5, 0.2])
def test_draws_count_in_which_an_effect_closes_enough(share: float) -> None:
    """Of a normal null, P(score > s) = q; of ten effects with this share, 1 - (1 - share q)^10.

    What is closed is not significant here, and four fifths of the level are left.
    """
    compared = _comparison(1.0, share)
    score = compared.tests["effect 0"].score
    tail = float(torch.special.ndtr(torch.tensor(-score)))
    expected = (1 - (1 - share * tail) ** 10) / 0.8
    # Four standard errors of 999 draws, and the median that the score is measured from.
    assert compared.naming_p_value("effect 0") == pytest.approx(expected, abs=0.06)


def test_an_effect_that_closes_too_little_is_compared_with_all() -> None:
    compared = _comparison(0.1, 0.2)
    assert compared.naming_p_value("effect 3") == compared.family_p_value("effect 3")


def test_a_name_is_significant_by_itself() -> None:
    """However rarely anything closes enough by chance."""
    compared = _comparison(1.0, 0.0)
    assert compared.naming_p_value("effect 0") == compared.tests["effect 0"].p_value


def test_an_effect_that_gains_nothing_is_significant_by_what_it_closes() -> None:
    """A form that is wrong inside images gains nothing, and yet predicts whole images."""
    generator = torch.Generator().manual_seed(2)
    drawn = torch.randn(10, DRAWS, generator=generator, dtype=torch.float64)
    tests = {
        f"effect {i}": _test(f"effect {i}", 0.0, 9.0 if i == 0 else 0.6, drawn[i])
        for i in range(10)
    }
    compared = _beside(tests)
    fifth = 1 / (DRAWS + 1) / 0.2  # No draw reaches it, and a fifth of the level is its share.
    assert compared.tests["effect 0"].p_value == pytest.approx(fifth)
    assert compared.naming_p_value("effect 0") == pytest.approx(fifth)
    assert compared.naming_p_value("effect 1") > 0.5


def test_chance_names_an_effect_as_often_as_the_level_says() -> None:
    """Where gains and what is closed are drawn like their null distributions, together or apart."""
    generator = torch.Generator().manual_seed(3)
    trials, effects, named = 200, 10, 0
    for trial in range(trials):
        gains = torch.randn(effects, DRAWS + 1, generator=generator, dtype=torch.float64)
        other = torch.randn(effects, DRAWS + 1, generator=generator, dtype=torch.float64)
        closed = gains + trial % 3 * other
        tests = {
            f"effect {i}": effect_test(
                f"effect {i}",
                closed[i, :1],
                gain=float(gains[i, 0]),
                null=gains[i, 1:],
                null_closed=closed[i, 1:],
            )
            for i in range(effects)
        }
        compared = _beside(tests, 0.0)
        named += min(compared.naming_p_value(name) for name in tests) <= 0.05
    # Three standard errors of that many trials above the level.
    assert named / trials <= 0.05 + 3 * (0.05 * 0.95 / trials) ** 0.5
