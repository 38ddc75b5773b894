"""The failures worth learning from: what was wrong, largest first, a few of each kind."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from benchmarks.withheld.outcomes import Outcome, findable, main_of

EACH = 5


@dataclass(frozen=True)
class Failure:
    """One recording and what went wrong."""

    kind: str
    outcome: Outcome

    @property
    def made_of(self) -> str:
        """What was in the recording."""
        case = self.outcome.answer["case"]
        usual = {
            "frames": 60,
            "moving": False,
            "order": "random",
            "tilt": True,
            "exposure": "random",
        }
        design = [
            f"{key} {case['design'][key]}"
            for key, value in usual.items()
            if case["design"][key] != value
        ]
        effects = [
            f"{name} {size:.1f} mm" for name, size in self.outcome.answer["sizes_mm"].items()
        ]
        more = [
            f"{key} {case[key]}"
            for key in ("noise", "wrong_base")
            if case[key] not in {"usual", "smooth"}
        ]
        return ", ".join(
            [
                *(effects or ["nothing"]),
                *design,
                *more,
                *(f"no {name}" for name in case["withhold"]),
            ]
        )

    @property
    def said(self) -> str:
        """What the program said."""
        said = self.outcome.said
        if said.failure:
            return said.failure.strip().splitlines()[-1][:200]
        sets = ["{" + ", ".join(sorted(members)) + "}" for members in said.sets]
        named = [f"{name} {members}" for name, members in zip(said.effects, sets, strict=False)]
        return "; ".join([*(named or ["nothing named"]), *(["unknown"] if said.unknown else [])])


def failures(outcomes: Sequence[Outcome]) -> list[Failure]:
    """At most a few failures of each kind, those with most to gain first."""
    single, several = findable(main_of(outcomes, "A")), findable(main_of(outcomes, "B"))
    everything = [one for one in outcomes if one.role == "main"]
    kinds: list[tuple[str, Sequence[Outcome], Callable[[Outcome], bool]]] = [
        ("the program failed", everything, lambda one: one.said.failure not in {"", "not run"}),
        (
            "one effect, another named",
            single,
            lambda one: bool(one.said.effects) and not one.covered(one.truth),
        ),
        ("one effect, nothing named", single, lambda one: not one.said.effects),
        (
            "several effects, not all named",
            several,
            lambda one: not one.must_find <= set(one.said.effects),
        ),
        (
            "an effect named where none is",
            main_of(outcomes, "C"),
            lambda one: not set(one.said.effects) <= one.truths,
        ),
        (
            "outside the catalogue, yet named",
            findable(main_of(outcomes, "D")),
            lambda one: one.wrong_single,
        ),
        (
            "left out of the catalogue, another named",
            findable(main_of(outcomes, "E")),
            lambda one: one.wrong_single,
        ),
        (
            "confounded design, a wrong single name",
            main_of(outcomes, "F"),
            lambda one: one.wrong_single,
        ),
        (
            "columns missing, a wrong single name",
            main_of(outcomes, "G"),
            lambda one: one.wrong_single,
        ),
        (
            "other noise, an effect named where none is",
            _nulls(outcomes, "I"),
            lambda one: bool(one.said.effects),
        ),
    ]
    found = []
    for kind, cases, wrong in kinds:
        ordered = sorted(filter(wrong, cases), key=lambda one: -one.oracle.plain.shrinkage_mm)
        found += [Failure(kind, one) for one in ordered[:EACH]]
    return found


def _nulls(outcomes: Sequence[Outcome], tier: str) -> list[Outcome]:
    return [one for one in main_of(outcomes, tier) if not one.truths]
