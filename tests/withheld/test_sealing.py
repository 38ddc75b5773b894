"""A seal that was broken is noticed."""

import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks.withheld import cases
from benchmarks.withheld.outcomes import open_answers
from benchmarks.withheld.sealing import BrokenSealError, digest, seal, unseal


def test_an_untouched_answer_opens(tmp_path: Path) -> None:
    commitment = seal(tmp_path / "a", {"truth": "lens"}, {"field": np.ones(3, np.float32)})
    assert unseal(tmp_path / "a", commitment)["truth"] == "lens"


def test_a_changed_answer_does_not_open(tmp_path: Path) -> None:
    commitment = seal(tmp_path / "a", {"truth": "lens"}, {})
    file = tmp_path / "a" / "answer.json"
    file.write_text(file.read_text().replace("lens", "warm_up"))
    with pytest.raises(BrokenSealError, match="not the answer that was sealed"):
        unseal(tmp_path / "a", commitment)


def test_a_changed_array_does_not_open(tmp_path: Path) -> None:
    commitment = seal(tmp_path / "a", {}, {"field": np.ones(3, np.float32)})
    np.save(tmp_path / "a" / "field.npy", np.zeros(3, np.float32))
    with pytest.raises(BrokenSealError, match=r"field\.npy is missing or is not the array"):
        unseal(tmp_path / "a", commitment)


def test_a_missing_answer_is_named(tmp_path: Path) -> None:
    with pytest.raises(BrokenSealError, match=r"answer\.json is missing"):
        unseal(tmp_path / "a", "0")


def test_an_answer_exchanged_for_another_sealed_one_does_not_open(tmp_path: Path) -> None:
    first = seal(tmp_path / "a", {"truth": "lens"}, {})
    seal(tmp_path / "b", {"truth": "warm_up"}, {})
    (tmp_path / "b" / "answer.json").rename(tmp_path / "a" / "answer.json")
    with pytest.raises(BrokenSealError):
        unseal(tmp_path / "a", first)


def test_a_diagnosis_changed_after_its_run_is_refused(tmp_path: Path) -> None:
    list(cases.generate(1, {"C": 1}, tmp_path))
    (entry,) = json.loads((tmp_path / "manifest.json").read_text())["recordings"]
    report = tmp_path / "diagnoses" / entry["id"]
    report.mkdir(parents=True)
    (tmp_path / "runs").mkdir()
    record = {"seconds": 1.0, "code": 0, "message": "", "report_sha256": digest(b"{}")}
    (tmp_path / "runs" / f"{entry['id']}.json").write_text(json.dumps(record))
    (report / "diagnosis.json").write_text('{"effects": ["lens"]}')
    with pytest.raises(BrokenSealError, match="changed after its run"):
        list(open_answers(tmp_path))
