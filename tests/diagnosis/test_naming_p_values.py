"""The p-value of a name: how often chance would name something."""

import pytest
import torch
from torch import Tensor

from tofcorr.diagnosis.findings.effect_comparison import EffectComparison, EffectTest

DRAWS = 999


def _test(name: str, gain: float, closed: float, null_closed: Tensor) -> EffectTest:
    generator = torch.Generator().manual_seed(sum(map(ord, name)))
    null = torch.randn(DRAWS, generator=generator, dtype=torch.float64)
    return EffectTest(
        name=name,
        closed=torch.tensor([closed], dtype=torch.float64),
        gain=gain,
        null=null,
        size=1,
        null_closed=null_closed,
    )


def _comparison(closed: float, share: float) -> EffectComparison:
    """Ten effects; in a share of the draws each closes 1, in the others nothing."""
    generator = torch.Generator().manual_seed(1)
    tests = {}
    for number in range(10):
        enough = torch.rand(DRAWS, generator=generator, dtype=torch.float64) < share
        tests[f"effect {number}"] = _test(f"effect {number}", 2.0, closed, enough.double())
    return EffectComparison(
        chosen=(), squares=torch.ones(1).double(), tests=tests, probes={}, least=0.5
    )


@pytest.mark.parametrize("share", [1.0, 0.5, 0.2])
def test_draws_count_in_which_an_effect_closes_enough(share: float) -> None:
    """Of a normal null, P(score > s) = q; of ten effects with this share, 1 - (1 - share q)^10."""
    compared = _comparison(1.0, share)
    score = compared.tests["effect 0"].score
    tail = float(torch.special.ndtr(torch.tensor(-score)))
    expected = 1 - (1 - share * tail) ** 10
    # Four standard errors of 999 draws, and the median that the score is measured from.
    assert compared.naming_p_value("effect 0") == pytest.approx(expected, abs=0.06)


def test_an_effect_that_closes_too_little_is_compared_with_all() -> None:
    compared = _comparison(0.1, 0.2)
    assert compared.naming_p_value("effect 3") == compared.family_p_value("effect 3")


def test_a_name_is_significant_by_itself() -> None:
    """However rarely anything closes enough by chance."""
    compared = _comparison(1.0, 0.0)
    assert compared.naming_p_value("effect 0") == compared.tests["effect 0"].p_value
