"""Scores of every kind of pair, each with Wilson's interval and, where there is one, its target."""

import math
from collections.abc import Iterable, Sequence

from benchmarks.withheld.pairs.degraded_scores import DEGRADE, Judgement
from benchmarks.withheld.pairs.outcomes import PairOutcome
from benchmarks.withheld.scoring.figures import Score, share_score
from benchmarks.withheld.statistics import share

SIZE_WITHIN = 0.05  # of the true gap as given
SHARE_WITHIN = 0.05  # of the squared gap
RATIO_WITHIN = 0.05  # of the true ratio of noises, and of amplitudes
DROPOUT_WITHIN = 0.002  # of the pixels on the target
NOTHING_MM = 1.0  # a gap that the robot's 0.3 mm and 0.3 mrad alone explain


def score_pairs(outcomes: Sequence[PairOutcome]) -> list[Score]:
    """All scores of the kinds that are there.

    A failed run counts as wrong in size, shares and cause; a field that a report lacks is not
    measured.
    """
    scores = []
    for kind in dict.fromkeys(one.kind for one in outcomes):
        cases = [one for one in outcomes if one.kind == kind]
        scores.append(counted(kind, "runs that failed", cases, lambda one: one.failed))
        has_gap = any(one.truth["shares"] for one in cases)
        judgements = [*(SIZE_AND_SHARES if has_gap else NO_GAP), *OF_KIND.get(kind, ())]
        scores += [counted(kind, what, cases, judge, least) for what, judge, least in judgements]
        if has_gap:
            scores += _single_shares(kind, cases)
    return scores


def counted(
    kind: str,
    what: str,
    cases: Iterable[PairOutcome],
    judge: Judgement,
    target: float | None = None,
) -> Score:
    """Share of the pairs judged true among those measured; a negative target is an upper one."""
    judged = [found for found in map(judge, cases) if found is not None]
    upper = target is not None and target < 0
    score = share_score(kind, what, share(judged), None if upper or not judged else target)
    if target is None:
        return score
    text = f"≤ {-target}" if upper else f"≥ {target}"
    met = None if not judged else score.value <= -target if upper else score.met
    return Score(kind, what, score.value, score.interval, score.count, text, met)


def size_right(one: PairOutcome) -> bool | None:
    """Whether the gap as given has its true size."""
    return False if one.failed else _near(one.size_ratio(), 1.0, SIZE_WITHIN)


def verdict_right(one: PairOutcome) -> bool | None:
    """Whether the first number of the verdict is the true gap as given."""
    return False if one.failed else _near(one.verdict_ratio(), 1.0, SIZE_WITHIN)


def no_gap(one: PairOutcome) -> bool | None:
    """Whether the gap as given is no larger than poses vary, where there is none."""
    said = one.stages.get("as_given")
    return None if said is None else said <= NOTHING_MM


def shares_right(one: PairOutcome) -> bool | None:
    """Whether every share of the attribution is right."""
    return _all_right(one, "shares")


def own_constants_right(one: PairOutcome) -> bool | None:
    """The same, if hand-eye and effect kept their own constants."""
    return _all_right(one, "own_constant_shares")


def _all_right(one: PairOutcome, truth: str) -> bool | None:
    if not one.truth["shares"]:
        return None
    errors = one.share_errors(truth)
    if errors is None:
        return False if one.failed else None
    return all(abs(error) <= SHARE_WITHIN for error in errors.values())


def _single_shares(kind: str, cases: Sequence[PairOutcome]) -> list[Score]:
    """Single shares that are right, and that lie in their intervals, of all pairs together."""
    with_gap = [one for one in cases if one.truth["shares"]]
    errors = [one.share_errors() or {} for one in with_gap]
    right = [abs(error) <= SHARE_WITHIN for one in errors for error in one.values()]
    covered = [found for one in with_gap for found in one.shares_covered()]
    return [
        share_score(kind, "single shares within 0.05", share(right)),
        share_score(kind, "single shares in their intervals", share(covered)),
    ]


def in_set(one: PairOutcome) -> bool | None:
    """Whether the withheld effect is in a set that was named."""
    return not one.failed and one.outcome.covered(one.outcome.truth)


def in_set_if_findable(one: PairOutcome) -> bool | None:
    """The same, only where the oracle finds the effect."""
    return in_set(one) if one.outcome.must_find else None


def named_falsely(one: PairOutcome) -> bool | None:
    """Whether an effect is named that is not withheld."""
    return None if one.failed else bool(one.false_names())


def shared_named(one: PairOutcome) -> bool | None:
    """Whether an effect is named that both have."""
    if one.failed or not one.outcome.answer["case"]["shared"]:
        return None
    return one.names_shared()


def noise_right(one: PairOutcome) -> bool | None:
    """Whether the ratio of the noises is right."""
    return _near(one.ratio("noise"), one.truth["noise_ratio"], RATIO_WITHIN)


def noise_reported(one: PairOutcome) -> bool | None:
    """Whether equal noises are reported as different: one lies outside the interval."""
    block = one.report.get("noise")
    if one.truth["noise_ratio"] != 1.0 or not block or not block.get("ratio_ci"):
        return None
    low, high = block["ratio_ci"]
    return not low <= 1.0 <= high


def dropouts_right(one: PairOutcome) -> bool | None:
    """Whether both shares of missing pixels are right."""
    block = one.report.get("dropouts")
    if not block:
        return None
    return all(
        abs(block[f"{who}_share"] - one.truth[f"{who}_dropouts"]) <= DROPOUT_WITHIN
        for who in ("real", "sim")
    )


def dropouts_reported(one: PairOutcome) -> bool | None:
    """Whether a difference of dropouts is significant where both drop alike."""
    block, dropouts = one.report.get("dropouts"), one.outcome.answer["case"]["dropouts"]
    if not block or dropouts[0] != dropouts[1] or block.get("p_value") is None:
        return None
    return block["p_value"] < 0.05


def amplitude_right(one: PairOutcome) -> bool | None:
    """Whether the ratio of the amplitudes is right."""
    block = one.report.get("amplitude")
    if not block:
        return None
    return _near(block.get("ratio"), one.truth["amplitude_ratio"], RATIO_WITHIN)


def _near(said: float | None, true: float | None, within: float) -> bool | None:
    if true is None or said is None or math.isnan(said):
        return None
    return abs(said / true - 1) <= within


SIZE_AND_SHARES: list[tuple[str, Judgement, float | None]] = [
    ("gap as given within 5 %", size_right, 0.95),
    ("first number of the verdict within 5 %", verdict_right, 0.95),
    ("every share within 0.05", shares_right, 0.90),
    ("the same, against shares with constants of their own", own_constants_right, None),
]
NO_GAP: list[tuple[str, Judgement, float | None]] = [
    ("gap as given at most 1 mm", no_gap, None),
]
CAUSE: list[tuple[str, Judgement, float | None]] = [
    ("effect in its set", in_set, 0.95),
    ("effect in its set, of those findable", in_set_if_findable, None),
    ("something else named", named_falsely, None),
]
BLOCKS: list[tuple[str, Judgement, float | None]] = [
    ("noise ratio within 5 %", noise_right, None),
    ("right noise, a difference reported", noise_reported, None),
    ("dropout shares within 0.002", dropouts_right, None),
    ("same dropouts, a difference reported", dropouts_reported, None),
    ("amplitude ratio within 5 %", amplitude_right, None),
]
NOTHING: list[tuple[str, Judgement, float | None]] = [
    ("an effect named though none is missing", named_falsely, -0.05),
    ("an effect named that both have", shared_named, -0.05),
]
OF_KIND: dict[str, list[tuple[str, Judgement, float | None]]] = {
    "ideal": [*CAUSE, *DEGRADE],
    "no_effect": [*NOTHING[:1], *DEGRADE],
    "hand_eye": CAUSE,
    "terms": CAUSE,
    "shared": [*CAUSE, NOTHING[1]],
    "nothing": NOTHING,
    "other": [("effect in its set", in_set, 0.85), *CAUSE[1:]],
    "other_nothing": [("an effect named though none is missing", named_falsely, -0.08)],
    "noise": [*NOTHING[:1], *BLOCKS],
    "renderer": CAUSE,
}
