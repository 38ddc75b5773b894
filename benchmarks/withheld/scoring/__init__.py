"""Scores of every tier, each with its interval and, where there is one, its target."""

from collections.abc import Callable, Sequence

from benchmarks.withheld.outcomes import Outcome
from benchmarks.withheld.scoring import inside, outside
from benchmarks.withheld.scoring.figures import Score, quantile_score, share_score
from benchmarks.withheld.scoring.real_images import real_images
from benchmarks.withheld.statistics import share

TIERS: dict[str, Callable[[Sequence[Outcome]], list[Score]]] = {
    "A": inside.single,
    "B": inside.several,
    "C": inside.nothing,
    "D": outside.outside,
    "E": outside.left_out,
    "F": outside.confounded,
    "G": outside.missing,
    "H": inside.few_frames,
    "I": inside.other_noise,
    "J": inside.other_base,
    "K": real_images,
}


def score_all(outcomes: Sequence[Outcome]) -> list[Score]:
    """All scores of the tiers that are there, and of the runs as such."""
    present = {outcome.tier for outcome in outcomes}
    scores = [one for tier, judge in TIERS.items() if tier in present for one in judge(outcomes)]
    return [*scores, *_runs(outcomes)]


def _runs(outcomes: Sequence[Outcome]) -> list[Score]:
    run = [one for one in outcomes if one.said.failure != "not run"]
    seconds = [one.said.seconds for one in run if one.answer["case"]["design"]["frames"] == 60]
    return [
        share_score("all", "runs that failed", share(bool(one.said.failure) for one in run)),
        quantile_score("all", "seconds for 60 frames, median", seconds, 0.5),
        quantile_score("all", "seconds for 60 frames, 90th percentile", seconds, 0.9),
    ]
