"""Scores of pairs: right by hand."""

from typing import Any

import pytest

from benchmarks.withheld.oracle import Gap, Oracle
from benchmarks.withheld.outcomes import Outcome, Said
from benchmarks.withheld.pairs.outcomes import PairOutcome
from benchmarks.withheld.pairs.scoring import score_pairs
from benchmarks.withheld.pairs.table import line
from benchmarks.withheld.scoring.figures import Score

TRUTH = {
    "as_given_mm": 10.0,
    "shares": {"hand_eye": 0.0, "distance": 0.7, "lens": 0.3},
    "own_constant_shares": {"hand_eye": 0.0, "distance": 0.75, "lens": 0.25},
    "noise_ratio": 2.0,
    "real_dropouts": 0.02,
    "sim_dropouts": 0.0,
    "amplitude_ratio": 1.0,
}


def an_outcome(report: dict[str, Any], kind: str = "ideal", failure: str = "") -> PairOutcome:
    effects, sets = report.get("effects", []), report.get("cause_sets", [])
    said = Said(tuple(effects), tuple(map(frozenset, sets)), failure=failure, report=report)
    gap = Gap(4.0, 0.5, {})
    oracle = Oracle(gap, gap, {"lens": 9.0}, {"lens": 1.0})
    case = {"tier": kind, "shared": [["motion", 3.0]], "dropouts": [0.02, 0.0]}
    answer = {"case": case, "sizes_mm": {"lens": 5.0}, "truth": TRUTH, "index": 0, "role": "main"}
    return PairOutcome(Outcome("r0", answer, oracle, said))


def score_of(outcomes: list[PairOutcome], what: str) -> Score:
    (found,) = [one for one in score_pairs(outcomes) if one.what == what]
    return found


def a_report(size: float, lens: float = 0.3, cause: str = "lens") -> dict[str, Any]:
    return {
        "stages": [{"name": "as_given", "gap_mm": size}],
        "attribution": [
            {"cause": "distance", "kind": "parameter", "share": 1 - lens, "ci": [0.6, 0.8]},
            {"cause": cause, "kind": "effect", "share": lens, "ci": [lens - 0.02, lens + 0.02]},
        ],
        "effects": [cause],
        "cause_sets": [sorted({cause, "lens"})],
    }


def test_size_share_and_cause_by_hand() -> None:
    outcomes = [
        an_outcome(a_report(10.4)),  # all right
        an_outcome(a_report(9.4)),  # 6 % too small
        an_outcome(a_report(10.0, lens=0.36)),  # shares 0.06 off
        an_outcome(a_report(10.0, cause="pixel") | {"cause_sets": [["pixel"]]}),  # wrong cause
        an_outcome(a_report(10.0, cause="target_shape")),  # another name, the truth in its set
        an_outcome({}, failure="it crashed"),
    ]
    assert score_of(outcomes, "gap as given within 5 %").value == pytest.approx(4 / 6)
    assert score_of(outcomes, "every share within 0.05").value == pytest.approx(3 / 6)
    assert score_of(outcomes, "effect in its set").value == pytest.approx(4 / 6)
    assert score_of(outcomes, "something else named").value == pytest.approx(1 / 5)
    covered = score_of(outcomes, "single shares in their intervals")
    assert covered.value == pytest.approx(8 / 10)  # all of distance; two of the effect are off
    assert score_of(outcomes, "runs that failed").value == pytest.approx(1 / 6)


def test_a_shared_effect_counts_as_named_unless_the_true_one_is_in_its_set() -> None:
    named = a_report(10.0, cause="motion")
    beside = an_outcome(named, "shared")
    alone = an_outcome(named | {"cause_sets": [["motion"]]}, "shared")
    assert score_of([beside, alone], "an effect named that both have").value == 0.5


def test_a_report_without_stages_and_blocks_is_not_measured() -> None:
    lacking = an_outcome({"effects": [], "cause_sets": []}, "noise")
    for what in ("gap as given within 5 %", "every share within 0.05", "noise ratio within 5 %"):
        score = score_of([lacking], what)
        assert score.count == 0
        assert score.met is None
        assert "not measured" in line(score)


def test_noise_and_dropouts_by_hand() -> None:
    noise, dropouts = {"real_mm": 4.0, "sim_mm": 1.95}, {"real_share": 0.0219, "sim_share": 0.0}
    off = {"noise": noise | {"sim_mm": 1.8}, "dropouts": dropouts | {"sim_share": 0.003}}
    right = an_outcome({"noise": noise, "dropouts": dropouts}, "noise")
    wrong = an_outcome(off, "noise")
    assert score_of([right, wrong], "noise ratio within 5 %").value == 0.5
    assert score_of([right, wrong], "dropout shares within 0.002").value == 0.5
