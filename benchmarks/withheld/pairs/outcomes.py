"""What the program said of a pair, beside what is true of it."""

import re
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from benchmarks.withheld.outcomes import Outcome
from benchmarks.withheld.pairs.degraded import Degraded

PARAMETERS = ("hand_eye", "distance", "pixel", "amplitude")


@dataclass(frozen=True)
class PairOutcome:
    """One pair; `None` stands for what was not measured, here and in the figures made of it."""

    outcome: Outcome
    degraded: Degraded | None = None

    @property
    def kind(self) -> str:
        """Kind of the pair."""
        return self.outcome.tier

    @property
    def truth(self) -> dict[str, Any]:
        """Sealed truth of the pair."""
        return self.outcome.answer["truth"]

    @property
    def failed(self) -> bool:
        """Whether the program ended with an error."""
        return bool(self.outcome.said.failure)

    @property
    def report(self) -> dict[str, Any]:
        """The diagnosis; empty if there is none."""
        return self.outcome.said.report

    @cached_property
    def stages(self) -> dict[str, float]:
        """Gap in millimetres by the name of its stage."""
        rows = self.report.get("stages") or []
        return {row["name"]: row["gap_mm"] for row in rows}

    @cached_property
    def intervals(self) -> dict[str, list[float]]:
        """95 % interval of each stage's gap in millimetres, by its name."""
        rows = self.report.get("stages") or []
        return {row["name"]: row["ci"] for row in rows if row.get("ci")}

    def size_ratio(self) -> float | None:
        """Gap as given over its true size."""
        said = self.stages.get("as_given")
        return None if said is None else said / self.truth["as_given_mm"]

    def verdict_ratio(self) -> float | None:
        """The first number of the verdict, which people read, over the true gap as given."""
        first = re.search(r"(\d+\.\d+) mm", self.report.get("verdict") or "")
        return None if first is None else float(first[1]) / self.truth["as_given_mm"]

    def share_errors(self, truth: str = "shares") -> dict[str, float] | None:
        """Share that was said minus the true one, of every cause that is there or was said.

        What was said of an effect whose set holds the true one is said of the true one.
        """
        rows = self.report.get("attribution")
        if rows is None:
            return None
        errors = {name: -share for name, share in self.truth[truth].items()}
        for row in rows:
            name = self._meant(row["cause"])
            errors[name] = errors.get(name, 0.0) + row["share"]
        return errors

    def shares_covered(self) -> list[bool]:
        """Whether each share that was said has the true one in its interval."""
        true = self.truth["shares"]
        return [
            row["ci"][0] <= true.get(self._meant(row["cause"]), 0.0) <= row["ci"][1]
            for row in self.report.get("attribution") or []
            if row.get("ci") and row["kind"] != "unexplained"
        ]

    def _meant(self, cause: str) -> str:
        for members in self.outcome.said.sets:
            for true in self.outcome.truths:
                if {cause, true} <= members and cause not in PARAMETERS:
                    return true
        return cause

    def false_names(self) -> set[str]:
        """Effects named whose set holds nothing that is withheld."""
        said, truths = self.outcome.said, self.outcome.truths
        return {
            name
            for name, members in zip(said.effects, said.sets, strict=False)
            if not members & truths
        }

    def names_shared(self) -> bool:
        """Whether an effect that both have is named, other than beside the true one in its set."""
        shared = {name for name, _ in self.outcome.answer["case"]["shared"]}
        return bool(shared & self.false_names())

    def ratio(self, block: str, real: str = "real_mm", simulated: str = "sim_mm") -> float | None:
        """A figure of the camera over the simulator's; None if either is missing or zero."""
        figures = self.report.get(block)
        if not figures or not figures.get(real) or not figures.get(simulated):
            return None
        return figures[real] / figures[simulated]
