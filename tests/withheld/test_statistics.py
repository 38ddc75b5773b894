"""Intervals and ranks against other implementations and values by hand."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binomtest

from benchmarks.withheld.baselines.distance_correlation import _centred, _correlation
from benchmarks.withheld.scoring.detection import _threshold
from benchmarks.withheld.statistics import Share, auroc, auroc_interval, macro_f1, quantile_interval


@given(total=st.integers(1, 500), part=st.floats(0, 1))
def test_wilson_interval_is_scipys(total: int, part: float) -> None:
    hits = round(part * total)
    theirs = binomtest(hits, total).proportion_ci(0.95, method="wilson")
    np.testing.assert_allclose(Share(hits, total).interval, (theirs.low, theirs.high), atol=1e-12)


def test_wilson_interval_by_hand() -> None:
    low, high = Share(1, 10).interval
    assert low == pytest.approx(0.0179, abs=1e-4)
    assert high == pytest.approx(0.4042, abs=1e-4)


def test_a_share_of_nothing_is_unknown() -> None:
    assert math.isnan(Share(0, 0).value)
    assert Share(0, 0).interval == (0.0, 1.0)


def test_auroc_is_sklearns_with_ties() -> None:
    metrics = pytest.importorskip("sklearn.metrics")
    rng = np.random.default_rng(0)
    positives, negatives = (
        rng.integers(0, 6, 40).astype(float),
        rng.integers(0, 5, 70).astype(float),
    )
    label = np.repeat([1, 0], [40, 70])
    theirs = metrics.roc_auc_score(label, np.concatenate([positives, negatives]))
    assert auroc(positives.tolist(), negatives.tolist()) == pytest.approx(theirs)


def test_auroc_interval_widens_with_fewer_cases() -> None:
    few, many = ([0.1, 0.9, 0.8], [0.2, 0.0, 0.85]), ([0.1, 0.9, 0.8] * 20, [0.2, 0.0, 0.85] * 20)
    width = [high - low for low, high in (auroc_interval(*few), auroc_interval(*many))]
    assert width[1] < width[0]


def test_macro_f1_by_hand() -> None:
    truths, named = [{"a", "b"}, {"a"}, set()], [{"a"}, {"c"}, set()]
    # a: 1 hit, 1 missed: 2/3. b: missed: 0. c: false: 0.
    assert macro_f1(truths, named, [set()] * 3) == pytest.approx((2 / 3) / 3)


def test_macro_f1_is_sklearns() -> None:
    metrics = pytest.importorskip("sklearn.metrics")
    rng = np.random.default_rng(1)
    true, said = rng.uniform(size=(30, 4)) < 0.4, rng.uniform(size=(30, 4)) < 0.5
    sets = [[{str(k) for k in np.flatnonzero(row)} for row in table] for table in (true, said)]
    ours = macro_f1(sets[0], sets[1], [set()] * 30)
    assert ours == pytest.approx(metrics.f1_score(true, said, average="macro"))


def test_neutral_effects_count_neither_way() -> None:
    assert macro_f1([{"a"}], [{"a", "weak"}], [{"weak"}]) == 1.0


def test_quantile_interval_covers_as_promised() -> None:
    rng = np.random.default_rng(0)
    draws = [quantile_interval(rng.uniform(size=60).tolist(), 0.5) for _ in range(400)]
    covered = np.mean([low <= 0.5 <= high for _, low, high in draws])
    assert covered > 0.92


def test_distance_correlation_of_a_line_is_one_and_of_noise_is_none() -> None:
    rng = np.random.default_rng(0)
    x = rng.normal(size=300)
    assert _correlation(_centred(x), _centred(3 * x + 1)) == pytest.approx(1.0)
    assert abs(_correlation(_centred(x), _centred(rng.normal(size=300)))) < 0.02


def test_threshold_of_detection_is_recovered_from_a_known_curve() -> None:
    rng = np.random.default_rng(0)
    sizes = np.exp(rng.uniform(-3, 3, 4000))
    found = rng.uniform(size=4000) < 1 / (1 + np.exp(-(math.log(4) + 2 * np.log(sizes))))
    assert _threshold(list(zip(sizes, found, strict=True))) == pytest.approx(1.0, rel=0.15)
