"""Tiers in which the right answer is not a name: D, E, F, G."""

from collections.abc import Sequence
from dataclasses import replace

from benchmarks.withheld.outcomes import Outcome, findable, main_of
from benchmarks.withheld.scoring.figures import Score, share_score
from benchmarks.withheld.statistics import auroc, auroc_interval, share


def outside(outcomes: Sequence[Outcome]) -> list[Score]:
    """Tier D: effects that no catalogue has; a dent fixed to the image is a pattern to some."""
    no_dent = [one for one in outcomes if one.tier != "D" or one.truth != "corner_dent"]
    without = _abstention(no_dent, "D", 0.95)[0]
    return [
        *_abstention(outcomes, "D", 0.95),
        replace(without, what="the same without the dent", target="", met=None),
    ]


def left_out(outcomes: Sequence[Outcome]) -> list[Score]:
    """Tier E: the catalogue without the true effect."""
    return _abstention(outcomes, "E", 0.85)


def _abstention(outcomes: Sequence[Outcome], tier: str, target: float) -> list[Score]:
    outside, inside = findable(main_of(outcomes, tier)), findable(main_of(outcomes, "A"))
    positives, negatives = ([one.said.abstains for one in cases] for cases in (outside, inside))
    area = auroc(positives, negatives)
    limits = auroc_interval(positives, negatives)
    what = "AUROC of abstention against findable effects of tier A"
    return [
        Score(tier, what, area, limits, len(outside), f"≥ {target}", area >= target),
        share_score(tier, "called unknown", share(one.said.unknown for one in outside)),
        share_score(tier, "a wrong single name", share(one.wrong_single for one in outside)),
        *(
            share_score(
                tier,
                f"called unknown: {name}",
                share(one.said.unknown for one in outside if one.truth == name),
            )
            for name in sorted({one.truth for one in outside})
            if tier == "D"
        ),
    ]


def confounded(outcomes: Sequence[Outcome]) -> list[Score]:
    """Tier F: designs that confound effects."""
    cases = main_of(outcomes, "F")
    must = findable(cases)
    absorbed = [one for one in cases if not one.must_find]
    wrong = share(one.wrong_single for one in cases)
    cured = {one.answer["main"]: one for one in outcomes if one.role == "cured"}
    open_sets = [
        one for one in must if one.said.sets and len(one.said.sets[0]) > 1 and one.name in cured
    ]
    resolved = share(cured[one.name].said.sets == (frozenset({one.truth}),) for one in open_sets)
    return [
        share_score(
            "F",
            "truth in the set, of those findable",
            share(one.covered(one.truth) for one in must),
            0.90,
        ),
        Score(
            "F",
            "a wrong single name",
            wrong.value,
            wrong.interval,
            wrong.total,
            "< 0.05",
            wrong.value < 0.05,
        ),
        share_score(
            "F",
            "nothing or a set named where calibration absorbs the effect",
            share(not one.wrong_single for one in absorbed),
        ),
        share_score(
            "F", "sets that the recording without the confounded design resolves", resolved
        ),
        share_score(
            "F",
            "of those sets, advice that names the remedy",
            share(_advises(one) for one in open_sets),
        ),
    ]


def _advises(one: Outcome) -> bool:
    """Whether the advice names what the confounded design lacks."""
    design = one.answer["case"]["design"]
    words = {
        design["exposure"] != "random": ("integration", "exposure"),
        design["order"] == "sorted": ("order", "random", "revisit", "return"),
        not design["tilt"]: ("tilt", "oblique", "incidence"),
        design["targets"] == "white": ("reflectiv", "checkerboard", "grey", "dark", "target"),
    }
    advice = " ".join(map(str, one.said.report.get("next_recording") or [])).lower()
    return any(word in advice for applies, these in words.items() if applies for word in these)


def missing(outcomes: Sequence[Outcome]) -> list[Score]:
    """Tier G: columns or files missing."""
    cases = main_of(outcomes, "G")
    blind = [one for one in cases if not one.answer["case"]["can_be_judged"]]
    judged = findable(one for one in cases if one.answer["case"]["can_be_judged"])
    said = share(_says_unavailable(one) for one in blind)
    return [
        share_score("G", "says that the true effect cannot be judged", said),
        share_score(
            "G",
            "unknown or a set instead of a name",
            share(one.said.unknown or not one.wrong_single for one in blind),
        ),
        share_score("G", "a wrong single name", share(one.wrong_single for one in blind)),
        share_score(
            "G",
            "in the set where it can be judged still",
            share(one.covered(one.truth) for one in judged),
        ),
    ]


def _says_unavailable(one: Outcome) -> bool:
    return any(
        row["effect"] == one.truth and not row["available"]
        for row in one.said.report.get("ranking", [])
    )
