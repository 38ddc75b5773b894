"""Answers kept apart from recordings, with hashes that show they were not touched in between.

`DIR/recordings` is all that the program sees, and `DIR/answers` holds what is true.
`DIR/manifest.json`, written before any run, names the recordings in random order with the SHA-256
of each answer.
"""

import hashlib
import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.renewed.geometry import Random
from benchmarks.renewed.recording import read
from benchmarks.sealed.oracle import Oracle, ask

Entry = dict[str, Any]


class BrokenSealError(Exception):
    """An answer is missing or is not the one that was sealed."""


def digest(content: bytes) -> str:
    """SHA-256 in hexadecimal."""
    return hashlib.sha256(content).hexdigest()


def seal(rng: Random, out: Path, answer: Entry, arrays: Mapping[str, np.ndarray]) -> str:
    """Write an answer, of a recording `id`, and its arrays; return the hash of all of them."""
    folder, hashes = out / "answers" / answer["id"], {}
    salt = rng.bytes(16).hex()  # so that the hash cannot be guessed from a list of answers
    folder.mkdir(parents=True)
    for name, array in arrays.items():
        np.save(folder / f"{name}.npy", array.astype(np.float32))
        hashes[name] = digest((folder / f"{name}.npy").read_bytes())
    text = json.dumps({**answer, "salt": salt, "arrays": hashes}, indent=1, sort_keys=True)
    (folder / "answer.json").write_text(text)
    return digest(text.encode())


def unseal(folder: Path, expected: str) -> dict[str, Any]:
    """Read an answer after checking it and its arrays against the hash.

    Raises:
        BrokenSealError: naming the file that is missing or differs.
    """
    try:
        text = (folder / "answer.json").read_bytes()
    except FileNotFoundError:
        raise BrokenSealError(f"{folder / 'answer.json'} is missing") from None
    if digest(text) != expected:
        raise BrokenSealError(f"{folder / 'answer.json'} is not the answer that was sealed")
    answer = json.loads(text)
    for name, value in answer["arrays"].items():
        file = folder / f"{name}.npy"
        if not file.exists() or digest(file.read_bytes()) != value:
            raise BrokenSealError(f"{file} is missing or is not the array that was sealed")
    return answer


def write_cases(seed: int, entries: Iterable[Entry], out: Path) -> Iterator[Entry]:
    """Write cases, yield the entry of each, and add them to the manifest in random order.

    Raises:
        FileExistsError: The folder holds cases already.
    """
    if (out / "manifest.json").exists():
        raise FileExistsError(f"{out} already holds cases; choose another folder")
    written = []
    for entry in entries:
        written.append(entry)
        yield entry
    order = np.random.default_rng([seed, 99]).permutation(len(written))
    recordings = [written[i] for i in order]
    manifest = {"format": "tofcorr-sealed", "version": 1, "recordings": recordings}
    out.mkdir(parents=True, exist_ok=True)
    (out / "manifest.json").write_text(json.dumps(manifest, indent=1))


def entries_of(out: Path) -> list[Entry]:
    """The entries of the manifest."""
    return json.loads((out / "manifest.json").read_text())["recordings"]


def load(out: Path, name: str, array: str) -> np.ndarray:
    """Load one sealed array as float64."""
    return np.load(out / "answers" / name / f"{array}.npy").astype(float)


@dataclass(frozen=True)
class Said:
    """The program's answer: effects in the order named, each with those it cannot be told from."""

    effects: tuple[str, ...] = ()
    sets: tuple[frozenset[str], ...] = ()
    unknown: bool = False
    failure: str = ""
    report: dict[str, Any] = field(default_factory=dict)

    @property
    def abstains(self) -> float:
        """How strongly it says that no effect of its catalogue explains the gap, from 0 to 2.

        Without the verdict `unknown` it is the unclosed share of a gap for which something was
        named, at most 1; with it, 1 is added. A recording in which nothing was detected is no
        abstention: 0.
        """
        closed = self.report["gap_mm"]["closed_fraction"] if self.report else 0.0
        left = 1.0 - float(np.clip(closed or 0.0, 0.0, 1.0))
        return (1.0 + left) if self.unknown else left if self.effects else 0.0


@dataclass(frozen=True)
class Outcome:
    """A recording's truth, the oracle's view of it, and what the program said."""

    name: str
    answer: dict[str, Any]
    oracle: Oracle
    said: Said

    @property
    def case(self) -> dict[str, Any]:
        """What was drawn."""
        return self.answer["case"]

    @property
    def tier(self) -> str:
        """Letter of the tier."""
        return self.case["tier"]

    @property
    def role(self) -> str:
        """`main`, or what kind of partner this is."""
        return self.answer["role"]

    @property
    def truths(self) -> frozenset[str]:
        """Effects that are in the recording."""
        return frozenset(self.answer["sizes_mm"])

    @property
    def truth(self) -> str:
        """The effect of a case that has one."""
        (name,) = self.truths
        return name

    @property
    def must_find(self) -> frozenset[str]:
        """Effects that the oracle shows to be findable."""
        return frozenset(name for name in self.truths if self.oracle.must_find(name))


def read_said(out: Path, name: str) -> Said:
    """Read the program's answer; a failed or missing run is an answer that names nothing."""
    record_file = out / "runs" / f"{name}.json"
    if not record_file.exists():
        return Said(failure="not run")
    record = json.loads(record_file.read_text())
    if record["code"] != 0:
        return Said(failure=record["message"] or f"exit code {record['code']}")
    content = (out / "diagnoses" / name / "diagnosis.json").read_bytes()
    if digest(content) != record["report_sha256"]:
        raise BrokenSealError(f"the diagnosis of {name} was changed after its run")
    report = json.loads(content)
    return Said(
        effects=tuple(report["effects"]),
        sets=tuple(frozenset(members) for members in report["cause_sets"]),
        unknown=bool(report["unknown"]),
        report=report,
    )


def open_answers(out: Path, each: Callable[..., Iterable[Outcome]] = map) -> Iterator[Outcome]:
    """Open the sealed answers, check them against the manifest, join them with what was said.

    The oracle's findings are kept in `out/oracle` and recomputed when that is removed. `each` maps
    a function over recordings, such as the `map` of a process pool.

    Raises:
        BrokenSealError: when an answer or a diagnosis is not the one that was committed to.
    """
    (out / "oracle").mkdir(exist_ok=True)
    yield from each(partial(_open_one, out), entries_of(out))


def _open_one(out: Path, entry: Entry) -> Outcome:
    name = entry["id"]
    answer = unseal(out / "answers" / name, entry["answer_sha256"])
    return Outcome(name, answer, oracle_of(out, name, answer), read_said(out, name))


def oracle_of(out: Path, name: str, answer: Mapping[str, Any]) -> Oracle:
    """The oracle's findings on one recording, from its file if there is one.

    Real images have no known truth without noise: what was done to them is taken as findable.
    """
    if "expected" not in answer["arrays"]:
        return Oracle(math.nan, math.nan, dict.fromkeys(answer["sizes_mm"], math.inf))
    file = out / "oracle" / f"{name}.json"
    if file.exists():
        return Oracle(**json.loads(file.read_text()))
    fields = {effect: load(out, name, f"field_{effect}") for effect in answer["sizes_mm"]}
    oracle = ask(read(out / "recordings" / name), fields, load(out, name, "expected"))
    file.write_text(json.dumps(asdict(oracle)))
    return oracle


def contradictions(report: Mapping[str, Any]) -> list[str]:
    """Which laws the content of a `diagnosis.json` breaks, in words."""
    names, sets, anything = report["effects"], report["cause_sets"], report["probability"]
    of_set, unknown = report["set_probabilities"], report["unknown"]
    judged = {row["effect"]: row["probability"] for row in report["ranking"] if row["available"]}
    members = [[judged[name] for name in own] for own in sets]
    gap, rounding = report["gap_mm"], 2e-4
    laws = {
        "detected is named or unknown": report["detected"] == (bool(names) or unknown),
        "each effect named leads its set": names == [own[0] for own in sets],
        "something is probably missing where an effect is named": not names or anything > 0.5,
        "each set is more probable than not": min(of_set, default=1) > 0.5,
        "a set is as probable as its members allow": all(
            max(own) - rounding <= one <= min(sum(own), anything) + rounding
            for one, own in zip(of_set, members, strict=True)
        ),
        "no effect is more probable than that any is there": anything + rounding
        >= max([*judged.values(), report["unknown_probability"]]),
        "the shares of a set are those of its members, and sum to 1 at most": all(
            [*shares] == own and sum(shares.values()) <= 1 + rounding
            for shares, own in zip(report["cause_sets_shares"], sets, strict=True)
        ),
        "the ranking falls": (falling := [*judged.values()]) == sorted(falling, reverse=True)
        or max(np.diff(falling)) <= 0.01,
        "intervals hold their figures": all(
            low <= gap[name] <= high
            for name in ("before", "after")
            for low, high in [gap[f"{name}_ci"]]
        ),
        "no gap closes where nothing is named": bool(names) or gap["after"] == gap["before"],
        "the verdict says what is named": all(name in report["verdict"] for name in names),
        "a verdict says that nothing explains what is unknown": not unknown
        or "explains" in report["verdict"],
    }
    return [law for law, holds in laws.items() if not holds]
