"""What a method said of a recording, and what was true of it, side by side."""

import json
import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.withheld.oracle import Gap, Oracle, ask, counted
from benchmarks.withheld.reading import read
from benchmarks.withheld.sealing import BrokenSealError, digest, unseal

CALLED = {"corner_dent": ("pixel", "fixed_pattern")}  # what an effect outside is rightly called


@dataclass(frozen=True)
class Said:
    """A method's answer: effects in the order named, each with those it cannot be told from."""

    effects: tuple[str, ...] = ()
    sets: tuple[frozenset[str], ...] = ()
    abstains: float = 0.0  # how strongly it says "something else"; see `abstention`
    unknown: bool = False
    failure: str = ""
    seconds: float = 0.0
    report: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Outcome:
    """A recording's truth, the oracle's view of it, and what the program said."""

    name: str
    answer: dict[str, Any]
    oracle: Oracle
    said: Said

    @property
    def tier(self) -> str:
        """Letter of the tier."""
        return self.answer["case"]["tier"]

    @property
    def truths(self) -> frozenset[str]:
        """Effects that are in the recording."""
        return frozenset(self.answer["sizes_mm"])

    @property
    def must_find(self) -> frozenset[str]:
        """Effects that the oracle shows to be findable."""
        return frozenset(name for name in self.truths if self.oracle.must_find(name))

    @property
    def truth(self) -> str:
        """The effect of a case that has one."""
        (name,) = self.truths
        return name

    @property
    def index(self) -> int:
        """Number of the case in its tier."""
        return self.answer["index"]

    @property
    def role(self) -> str:
        """`main`, or what kind of partner this is."""
        return self.answer["role"]

    def covered(self, effect: str) -> bool:
        """Whether an effect is in one of the sets named."""
        return any(effect in members for members in self.said.sets)

    @property
    def wrong_single(self) -> bool:
        """Whether a single effect is blamed that is not there."""
        right = self.truths | {name for truth in self.truths for name in CALLED.get(truth, ())}
        return any(len(members) == 1 and not members & right for members in self.said.sets)


def abstention(report: dict[str, Any]) -> float:
    """How strongly a diagnosis says that no effect of its catalogue explains the gap, from 0 to 2.

    Without the verdict `unknown` it is the unclosed share of a gap for which something was named,
    at most 1; with it, 1 is added. A recording in which nothing was detected is no abstention: 0.
    """
    unknown = bool(report["unknown"])
    left = 1.0 - float(np.clip(report["gap_mm"]["closed_fraction"] or 0.0, 0.0, 1.0))
    return (1.0 + left) if unknown else left if report["effects"] else 0.0


def read_said(out: Path, name: str) -> Said:
    """Read the program's answer; a failed or missing run is an answer that names nothing."""
    record_file = out / "runs" / f"{name}.json"
    if not record_file.exists():
        return Said(failure="not run")
    record = json.loads(record_file.read_text())
    if record["code"] != 0:
        return Said(
            failure=record["message"] or f"exit code {record['code']}", seconds=record["seconds"]
        )
    content = (out / "diagnoses" / name / "diagnosis.json").read_bytes()
    if digest(content) != record["report_sha256"]:
        raise BrokenSealError(f"the diagnosis of {name} was changed after its run")
    report = json.loads(content)
    return Said(
        effects=tuple(report["effects"]),
        sets=tuple(frozenset(members) for members in report["cause_sets"]),
        abstains=abstention(report),
        unknown=bool(report["unknown"]),
        seconds=record["seconds"],
        report=report,
    )


def read_baselines(out: Path, name: str) -> dict[str, Said]:
    """What each baseline said of a recording; empty if they have not seen it."""
    file = out / "baselines" / f"{name}.json"
    if not file.exists():
        return {}
    return {
        title: Said(tuple(one["effects"]), tuple(frozenset(members) for members in one["sets"]))
        for title, one in json.loads(file.read_text()).items()
    }


def open_answers(out: Path, each: Callable[..., Iterable[Outcome]] = map) -> Iterator[Outcome]:
    """Open the sealed answers, check them against the manifest, join them with what was said.

    The oracle's findings are kept in `out/oracle` and recomputed when that is removed. `each` maps
    a function over recordings, such as the `map` of a process pool.

    Raises:
        BrokenSealError: when an answer or a diagnosis is not the one that was committed to.
    """
    (out / "oracle").mkdir(exist_ok=True)
    entries = json.loads((out / "manifest.json").read_text())["recordings"]
    yield from each(partial(_open_one, out), entries)


def _open_one(out: Path, entry: dict[str, Any]) -> Outcome:
    name = entry["id"]
    answer = unseal(out / "answers" / name, entry["answer_sha256"])
    return Outcome(name, answer, oracle_of(out, name, answer), read_said(out, name))


def oracle_of(out: Path, name: str, answer: dict[str, Any]) -> Oracle:
    """The oracle's findings on one recording, from its file if there is one."""
    file = out / "oracle" / f"{name}.json"
    if file.exists():
        kept = json.loads(file.read_text())
        plain, weighted = Gap(**kept["plain"]), Gap(**kept["weighted"])
        again = Gap(**kept["counted"]) if kept.get("counted") else None
        return Oracle(plain, weighted, kept["evidence"], kept["left"], again)
    if answer["case"]["tier"] == "K":
        return _assumed(answer["sizes_mm"])
    fields = {effect: load(out, name, f"field_{effect}") for effect in answer["sizes_mm"]}
    noise = "noise" in answer["arrays"]
    count = counted(load(out, name, "noise")) if noise else None
    oracle = ask(read(out / "recordings" / name), fields, load(out, name, "expected"), count)
    kept = {"plain": vars(oracle.plain), "weighted": vars(oracle.weighted)}
    if oracle.counted is not None:
        kept["counted"] = vars(oracle.counted)
    file.write_text(json.dumps(kept | {"evidence": oracle.evidence, "left": oracle.left}))
    return oracle


def _assumed(sizes_mm: dict[str, float]) -> Oracle:
    """Real images have no known truth without noise: what was done to them is taken as findable."""
    unknown = Gap(math.nan, math.nan, {})
    return Oracle(unknown, unknown, dict.fromkeys(sizes_mm, math.inf), dict.fromkeys(sizes_mm, 1.0))


def load(out: Path, name: str, array: str) -> np.ndarray:
    """Load one sealed array as float64."""
    return np.load(out / "answers" / name / f"{array}.npy").astype(float)


def main_of(outcomes: Iterable[Outcome], tier: str) -> list[Outcome]:
    """The main recordings of a tier."""
    return [one for one in outcomes if one.tier == tier and one.role == "main"]


def findable(outcomes: Iterable[Outcome]) -> list[Outcome]:
    """Recordings in which there is something to find."""
    return [one for one in outcomes if one.must_find]


def named_first(one: Outcome) -> bool:
    """Whether the true effect is the first one named."""
    return one.said.effects[:1] == (one.truth,)


def exact(one: Outcome) -> bool:
    """Whether the effects named are those that must be found, up to true ones that could not be."""
    return one.must_find <= set(one.said.effects) <= one.truths
