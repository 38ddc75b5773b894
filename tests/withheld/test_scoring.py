"""Scores of outcomes made by hand, and the way from run to page."""

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.withheld import cases, diagnose
from benchmarks.withheld.__main__ import counts_of
from benchmarks.withheld.oracle import Gap, Oracle
from benchmarks.withheld.outcomes import Outcome, Said, abstention, open_answers
from benchmarks.withheld.page import write_page
from benchmarks.withheld.scoring import score_all
from benchmarks.withheld.scoring.comparison import Row, ahead
from benchmarks.withheld.statistics import Share

CASE = {
    "noise": "usual",
    "wrong_base": "smooth",
    "withhold": [],
    "exclude": [],
    "can_be_judged": True,
    "design": {
        "frames": 60,
        "moving": False,
        "order": "random",
        "tilt": True,
        "exposure": "random",
        "targets": "mixed",
    },
}


def report(effects: list[str], sets: list[list[str]], **more: Any) -> dict[str, Any]:
    closed = 0.9 if effects else 0.0
    gap = {"closed_fraction": closed, "closed_ci": [closed - 0.1, closed + 0.1]}
    kept = {"effects": effects, "cause_sets": sets, "unknown": False, "gap_mm": gap, "ranking": []}
    return kept | {"minimum_detectable_mm": {}, "next_recording": [], "detected": True} | more


def outcome(
    tier: str,
    truths: dict[str, float],
    effects: list[str],
    sets: list[list[str]] | None = None,
    evidence: float = 10.0,
    about: dict[str, Any] | None = None,
    **more: Any,
) -> Outcome:
    sets = [[name] for name in effects] if sets is None else sets
    told = report(effects, sets, **more)
    said = Said(
        tuple(effects),
        tuple(map(frozenset, sets)),
        abstention(told),
        told["unknown"],
        seconds=1.0,
        report=told,
    )
    gap = Gap(4.0, 0.5, {})
    oracle = Oracle(gap, gap, dict.fromkeys(truths, evidence), dict.fromkeys(truths, 1.0))
    answer = {"sizes_mm": truths, "role": "main", "index": 0, "case": CASE | {"tier": tier}}
    answer |= about or {}
    return Outcome("r0", answer, oracle, said)


def value(outcomes: list[Outcome], what: str) -> float:
    (found,) = [one.value for one in score_all(outcomes) if one.what.startswith(what)]
    return found


def test_named_first_in_the_set_and_size_of_the_set_by_hand() -> None:
    cases_of_a = [
        outcome("A", {"lens": 3.0}, ["lens"]),
        outcome("A", {"lens": 3.0}, ["pixel"], [["pixel", "lens"]]),
        outcome("A", {"lens": 3.0}, ["motion"], [["motion", "pixel", "warm_up"]]),
        outcome("A", {"lens": 3.0}, []),
        outcome("A", {"lens": 0.1}, ["motion"], evidence=0.5),  # not findable: does not count
    ]
    assert value(cases_of_a, "named first, of those findable") == pytest.approx(1 / 4)
    assert value(cases_of_a, "in the set") == pytest.approx(2 / 4)
    assert value(cases_of_a, "size of the set") == pytest.approx(2.0)
    assert value(cases_of_a, "exactly the true effect") == pytest.approx(1 / 4)


def test_a_false_alarm_rate_meets_its_target_by_its_upper_limit() -> None:
    nulls = [outcome("C", {}, ["lens"] if k < 20 else []) for k in range(400)]
    (alarm,) = [one for one in score_all(nulls) if one.what.startswith("an effect named")]
    assert alarm.value == pytest.approx(0.05)
    assert alarm.met
    (alarm,) = [one for one in score_all(nulls[:40]) if one.what.startswith("an effect named")]
    assert not alarm.met


def test_naming_the_true_effect_of_a_fifth_of_a_millimetre_is_no_false_alarm() -> None:
    nearly = [outcome("C", {"lens": 0.2}, ["lens"]), outcome("C", {"lens": 0.2}, ["motion"])]
    assert value(nearly, "a false effect named beside one") == pytest.approx(0.5)


def test_a_wrong_single_name_is_one_whose_set_lacks_every_truth() -> None:
    confounded = [
        outcome("F", {"lens": 3.0}, ["pixel"]),
        outcome("F", {"lens": 3.0}, ["pixel"], [["pixel", "motion"]]),
        outcome("F", {"lens": 3.0}, ["lens"]),
        outcome("F", {"lens": 3.0}, []),
    ]
    assert value(confounded, "a wrong single name") == pytest.approx(1 / 4)
    assert value(confounded, "truth in the set") == pytest.approx(1 / 4)


def test_abstention_orders_unknown_above_unclosed_above_closed_above_silent() -> None:
    unknown = report([], [], unknown=True)
    poor = report(["lens"], [["lens"]], gap_mm={"closed_fraction": 0.2})
    good = report(["lens"], [["lens"]], gap_mm={"closed_fraction": 0.95})
    scores = [abstention(one) for one in (unknown, poor, good, report([], []))]
    assert scores == sorted(scores, reverse=True)
    assert scores[-1] == 0.0


def test_silence_is_no_abstention() -> None:
    silent = [outcome("D", {"stripes": 5.0}, []) for _ in range(5)]
    named = [outcome("A", {"lens": 5.0}, ["lens"]) for _ in range(5)]
    assert value([*silent, *named], "AUROC") == 0.0


def test_intervals_are_held_against_a_fresh_session() -> None:
    outcomes = []
    for k, closed in enumerate((0.85, 0.95, 0.5)):
        one = outcome("A", {"lens": 3.0}, ["lens"], about={"id": f"m{k}"})
        outcomes.append(Outcome(f"m{k}", one.answer, one.oracle, one.said))
        outcomes.append(
            outcome(
                "A",
                {"lens": 3.0},
                ["lens"],
                about={"role": "fresh", "main": f"m{k}"},
                gap_mm={"closed_fraction": closed, "closed_ci": [0, 1]},
            )
        )
    assert value(outcomes, "intervals of the closed share that hold what a fresh") == pytest.approx(
        2 / 3
    )


def test_terms_of_a_base_of_the_wrong_form_are_not_false_names() -> None:
    wrong = {"case": CASE | {"tier": "J", "wrong_base": "distance"}}
    outcomes = [
        outcome("J", {}, ["distance"], about=wrong),
        outcome("J", {}, ["wiggling"], about=wrong),
        outcome("J", {}, ["motion"], about=wrong),
    ]
    assert value(outcomes, "named beside the base's own terms") == pytest.approx(1 / 3)


def test_the_program_is_ahead_only_with_more_exact_sets_and_no_more_false_alarms() -> None:
    def row(exact: int, false: int) -> Row:
        return Row("m", Share(9, 10), Share(exact, 10), Share(exact, 10), Share(false, 100))

    assert ahead([row(9, 4), row(7, 60)])
    assert not ahead([row(6, 4), row(7, 60)])
    assert not ahead([row(9, 20), row(7, 6)])


def test_counts_of_tiers_are_read_from_text() -> None:
    assert counts_of("A,C:400", 40) == {"A": 40, "C": 400}


STUB = """
import json, sys
from pathlib import Path
for line in sys.stdin:
    arguments = json.loads(line)["arguments"]
    out, recording = (Path(arguments[arguments.index(key) + 1]) for key in ("--out", "--recording"))
    kind = sum(map(ord, recording.name)) % 3
    if kind == 0:
        sys.exit(3)
    answer = {"seconds": 1.5, "code": kind - 1, "message": "" if kind == 1 else "boom"}
    if kind == 1:
        out.mkdir()
        (out / "diagnosis.json").write_text(sys.argv[1])
    print(json.dumps(answer), flush=True)
"""


@pytest.mark.slow
def test_runs_are_recorded_resumed_and_scored_whether_they_succeed_fail_or_die(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    list(cases.generate(2, {"A": 3, "C": 3}, tmp_path))
    (tmp_path / "stub.py").write_text(STUB)
    told = json.dumps(report(["lens"], [["lens"]]))
    monkeypatch.setattr(diagnose, "COMMAND", [sys.executable, str(tmp_path / "stub.py"), told])
    waiting = diagnose.waiting(tmp_path)
    codes = dict(diagnose.diagnose(tmp_path, waiting, diagnose.Plan(workers=2)))
    names = {
        entry["id"] for entry in json.loads((tmp_path / "manifest.json").read_text())["recordings"]
    }
    assert set(codes) == names
    for name, code in codes.items():
        kind = sum(map(ord, name)) % 3
        assert code == {0: 3, 1: 0, 2: 1}[kind]
    assert diagnose.waiting(tmp_path) == []
    outcomes = list(open_answers(tmp_path))
    failed = {one.name for one in outcomes if one.said.failure}
    assert failed == {name for name, code in codes.items() if code}
    write_page(outcomes, tmp_path, "A trial")
    page = (tmp_path / "page.html").read_text()
    assert "A trial" in page
    assert "data:image/png;base64" in page
    assert "| all | runs that failed |" in (tmp_path / "page.md").read_text()
    assert np.isfinite(json.loads((tmp_path / "scores.json").read_text())["scores"][0]["count"])


def test_a_page_of_real_images_alone_has_no_figures_of_simulated_tiers(tmp_path: Path) -> None:
    added = outcome("K", {"wiggling": 6.0}, ["wiggling"], about={"role": "added"})
    scores = write_page([added], tmp_path, "Real images")
    assert "added effect in a set" in {one.what for one in scores}
    assert "What is taken for what" not in (tmp_path / "page.html").read_text()
