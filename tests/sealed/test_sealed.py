"""Sealed answers open only untouched; runs are recorded and scored; figures are right by hand."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from sealed.perfect_robot import exactly

from benchmarks.renewed import __main__ as renewed
from benchmarks.renewed.cases import make_case, write_case
from benchmarks.renewed.geometry import inverse
from benchmarks.renewed.real import FORMS, STRIDE, thinned, write_real
from benchmarks.renewed.recording import Data, read, write_recording
from benchmarks.sealed import running
from benchmarks.sealed.answers import (
    BrokenSealError,
    Outcome,
    Said,
    digest,
    open_answers,
    read_said,
    seal,
    unseal,
    write_cases,
)
from benchmarks.sealed.oracle import Oracle, ask, counted, linearise
from benchmarks.sealed.scores import (
    ANY,
    Share,
    area_score,
    covers,
    macro_f1,
    quantile_score,
    share_score,
    wrong,
)
from benchmarks.withheld import __main__ as withheld


def sealed(out: Path, name: str, effect: str, arrays: dict[str, np.ndarray] | None = None) -> str:
    answer = {"id": name, "truth": effect}
    return seal(np.random.default_rng(0), out, answer, arrays or {})


def test_an_answer_opens_only_untouched_and_in_its_place(tmp_path: Path) -> None:
    commitment = sealed(tmp_path, "a", "lens", {"field": np.ones(3)})
    folder = tmp_path / "answers" / "a"
    assert unseal(folder, commitment)["truth"] == "lens"
    np.save(folder / "field.npy", np.zeros(3, np.float32))
    with pytest.raises(BrokenSealError, match=r"field\.npy is missing or is not the array"):
        unseal(folder, commitment)
    sealed(tmp_path, "b", "warm_up")
    (tmp_path / "answers" / "b" / "answer.json").rename(folder / "answer.json")
    with pytest.raises(BrokenSealError, match="not the answer that was sealed"):
        unseal(folder, commitment)
    (folder / "answer.json").unlink()
    with pytest.raises(BrokenSealError, match=r"answer\.json is missing"):
        unseal(folder, commitment)


def report(effects: list[str], sets: list[list[str]], **more: Any) -> dict[str, Any]:
    gap = {"closed_fraction": 0.9, "closed_ci": [0.8, 0.95]}
    return {"effects": effects, "cause_sets": sets, "unknown": False, "gap_mm": gap} | more


def filed(out: Path, name: str, said: dict[str, Any], sha256: str | None = None) -> None:
    content = json.dumps(said).encode()
    (out / "diagnoses" / name).mkdir(parents=True)
    (out / "diagnoses" / name / "diagnosis.json").write_bytes(content)
    (out / "runs").mkdir(exist_ok=True)
    record = {"seconds": 1.0, "code": 0, "message": "", "report_sha256": sha256 or digest(content)}
    (out / "runs" / f"{name}.json").write_text(json.dumps(record))


def test_a_diagnosis_changed_after_its_run_is_refused(tmp_path: Path) -> None:
    filed(tmp_path, "r1", report([], []), digest(b"{}"))
    with pytest.raises(BrokenSealError, match="changed after its run"):
        read_said(tmp_path, "r1")


def test_runs_are_recorded_resumed_and_scored_whether_they_succeed_or_fail(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    entries = list(write_cases(1, (write_case(1, tier, 0, tmp_path) for tier in "ENO"), tmp_path))
    with pytest.raises(FileExistsError):
        list(write_cases(1, iter(()), tmp_path))

    def answer(arguments: list[str], limit_s: float) -> dict[str, Any]:
        out = Path(arguments[arguments.index("--out") + 1])
        bad = out.name == entries[0]["id"]
        if not bad:
            out.mkdir(parents=True)
            (out / "diagnosis.json").write_text(json.dumps(report(["lens"], [["lens"]])))
        return {"seconds": 1.0, "code": int(bad), "message": "boom" if bad else ""}

    monkeypatch.setattr(running, "run", answer)
    for folder in ("diagnoses", "runs", "configs"):
        (tmp_path / folder).mkdir()
    assert len(running.waiting(tmp_path)) == 3
    codes = [running.run_one(tmp_path, entry, config="page: false\n") for entry in entries]
    assert codes == [1, 0, 0]
    assert running.waiting(tmp_path) == []
    outcomes = list(open_answers(tmp_path))
    assert [one.said.failure for one in outcomes if one.said.failure] == ["boom"]
    assert [one.oracle for one in open_answers(tmp_path)] == [one.oracle for one in outcomes]
    scores, text = renewed.score_all(outcomes, tmp_path)
    assert "| all | runs that failed | 0.33" in text
    assert {one.tier for one in scores} >= {"nothing", "all"}


def test_a_command_that_fails_or_takes_too_long_is_a_result(tmp_path: Path) -> None:
    missing = ["diagnose", "--recording", str(tmp_path / "none"), "--out", str(tmp_path / "out")]
    found = running.run(missing, 60.0)
    assert found["code"] != 0
    assert running.run(["--help"], 60.0)["code"] == 0


def outcome(
    tier: str, sizes: dict[str, float], said: dict[str, Any], role: str = "main", **case: Any
) -> Outcome:
    answer = {"case": {"tier": tier, **case}, "sizes_mm": sizes, "role": role}
    names = said["effects"], [frozenset(one) for one in said["cause_sets"]]
    told = Said(tuple(names[0]), tuple(names[1]), said["unknown"], report=said)
    return Outcome(role, answer, Oracle(4.0, 1.0, dict.fromkeys(sizes, 9.0)), told)


def test_figures_of_the_regression_set_by_hand(tmp_path: Path) -> None:
    lens, unavailable = {"lens": 5.0}, [{"effect": "lens", "available": False}]
    cases = [
        outcome("A", lens, report(["lens"], [["lens"]])),
        outcome("A", lens, report(["warm_up", "lens"], [["warm_up"], ["lens", "target_shape"]])),
        outcome("C", {}, report(["warm_up"], [["warm_up"]])),
        outcome("D", {"parallax": 5.0}, report([], [], unknown=True)),
        outcome("G", lens, report([], [], ranking=unavailable), judged=False),
    ]
    scores, _ = withheld.score_all(cases, tmp_path)
    found = {(one.tier, one.what): one.value for one in scores}
    assert found["A", "named first"] == 0.5
    assert found["A", "in the set"] == 1.0
    assert found["A", "shrinkage against the oracle, median"] == pytest.approx(0.9 / (15 / 16))
    assert found["C", "named though nothing is there"] == 1.0
    assert found["D", "AUROC of abstention against tier A"] == 1.0
    assert found["G", "says that the effect cannot be judged"] == 1.0


def test_abstention_orders_unknown_above_unclosed_above_closed_above_silent() -> None:
    def abstains(effects: list[str], closed: float, unknown: bool) -> float:
        gap = {"closed_fraction": closed}
        return outcome("A", {}, report(effects, [], gap_mm=gap, unknown=unknown)).said.abstains

    order = [([], 0.0, True), (["lens"], 0.2, False), (["lens"], 0.9, False), ([], 0.0, False)]
    values = [abstains(*one) for one in order]
    assert values == sorted(values, reverse=True)
    assert values[-1] == 0.0


def test_a_wrong_single_name_is_one_whose_set_lacks_the_truth() -> None:
    one = outcome("E", {"robot_kinematics": 4.0}, report(["backlash"], [["backlash"]]))
    assert covers(one, "robot_kinematics")
    assert not wrong(one)
    assert wrong(outcome("E", {"lens": 4.0}, report(["warm_up"], [["warm_up"]])))
    assert not wrong(outcome("E", {"lens": 4.0}, report(["warm_up"], [["warm_up", "fan"]])))


def test_shares_areas_quantiles_and_f1_by_hand() -> None:
    assert Share(1, 10).interval == pytest.approx((0.0179, 0.4042), abs=1e-4)
    assert np.isnan(Share(0, 0).value)
    assert Share(0, 0).interval == (0.0, 1.0)
    measured = share_score("A", "x", [True, False, None])
    assert (measured.value, measured.count) == (0.5, 2)
    area = area_score("D", "x", [2.0, 1.0, 1.0], [0.0, 1.0], ANY)
    assert area.value == pytest.approx((1 + 1 + 0.5 + 1 + 0.5 + 0) / 6 + 0.0, abs=0.2)
    rng = np.random.default_rng(0)
    draws = [quantile_score("A", "", rng.uniform(size=60).tolist(), 0.5, ANY) for _ in range(200)]
    assert np.mean([one.interval[0] <= 0.5 <= one.interval[1] for one in draws]) > 0.9
    cases = [
        outcome("B", {"a": 1.0, "b": 1.0}, report(["a"], [["a"]])),
        outcome("B", {"a": 1.0}, report(["c"], [["c"]])),
    ]
    # a: one hit, one missed: 2/3. b: missed: 0. c: false: 0.
    assert macro_f1(cases) == pytest.approx((2 / 3) / 3)


def recorded(folder: Path) -> tuple[Data, np.ndarray, Any]:
    rng = np.random.default_rng(4)
    case = make_case(rng, wanted={"frames": 40, "mask": "exact", "robot": 0.0, "moving": False})
    write_recording(folder, exactly(rng, case.recorded, case.truth))
    return read(folder), case.truth.expected, case


def test_the_fit_finds_the_hand_eye(tmp_path: Path) -> None:
    data, _, case = recorded(tmp_path / "r")
    miss = inverse(case.world.tool_from_camera) @ linearise(data).tool_from_camera
    assert np.linalg.norm(miss[:3, 3]) < 2e-3
    assert np.abs(miss[:3, :3] - np.eye(3)).max() < 2e-3
    assert counted(np.array([0.0, 5e-3])).tolist() == [1.0, 0.5]


def test_the_oracle_closes_what_is_there_and_finds_nothing_that_is_not(tmp_path: Path) -> None:
    data, expected, _ = recorded(tmp_path / "r")
    # A pattern of random signs is nothing to the base: the gap is the pattern.
    sign = np.random.default_rng(0).choice([-1.0, 1.0], data.depth.shape[1:])
    field = np.broadcast_to(4e-3 * sign, data.depth.shape)

    def asked(part: np.ndarray, name: str) -> Oracle:
        return ask(replace(data, depth=data.depth + part), {name: part}, expected + part)

    whole = asked(field, "pattern")
    assert whole.before_mm == pytest.approx(4.0, abs=0.15)
    assert whole.after_mm < 0.4
    assert whole.must_find("pattern")
    # What calibration absorbs need not be found.
    offset = asked(np.full(data.depth.shape, 5e-3), "offset")
    assert not offset.must_find("offset")
    assert offset.before_mm == pytest.approx(offset.after_mm, abs=1e-3)
    rng = np.random.default_rng(0)
    noise = {f"c{k}": rng.normal(0, 1e-3, (40, 1, 1)) + 0 * expected for k in range(8)}
    assert sum(map(ask(data, noise, expected).must_find, noise)) <= 1


def test_the_command_line_refuses_kinds_that_are_not_there(tmp_path: Path) -> None:
    arguments = ["generate", "--seed", "1", "--tiers", "A,X:3", "--out", str(tmp_path)]
    found = CliRunner().invoke(withheld.main, arguments)
    assert found.exit_code == 2
    assert "no tier 'X': expected some of A, B" in found.output


def test_a_thinned_recording_looks_along_every_third_ray(tmp_path: Path) -> None:
    write_recording(tmp_path / "full", make_case(np.random.default_rng(0)).recorded)
    full, less = read(tmp_path / "full"), read(thinned(tmp_path / "full", tmp_path / "thin"))
    np.testing.assert_allclose(less.rays, full.rays[::STRIDE, ::STRIDE], atol=1e-9)
    np.testing.assert_array_equal(less.depth, full.depth[:, ::STRIDE, ::STRIDE])


@pytest.mark.slow
def test_real_images_differ_from_the_plain_ones_by_the_sealed_effect(
    tmp_path: Path, real_data: Path
) -> None:
    forms = [name for name in FORMS if "rendered" not in name]
    answers = [
        unseal(tmp_path / "answers" / entry["id"], entry["answer_sha256"])
        for entry in write_real(1, tmp_path, forms)
    ]
    (plain,) = [one["id"] for one in answers if one["role"] == "plain"]
    before = read(tmp_path / "recordings" / plain)
    for one in answers:
        change = (read(tmp_path / "recordings" / one["id"]).depth - before.depth)[before.valid]
        wanted = next(iter(one["sizes_mm"].values()), 0.0)
        assert 1e3 * np.sqrt(np.mean(change**2)) == pytest.approx(wanted, rel=1e-3, abs=1e-4)
