"""Tier K: real images with an effect added or a term withheld."""

from collections.abc import Sequence

from benchmarks.withheld.outcomes import Outcome, named_first
from benchmarks.withheld.scoring.figures import Score, share_score
from benchmarks.withheld.statistics import share


def real_images(outcomes: Sequence[Outcome]) -> list[Score]:
    """What is named of what was done to the images, beside what they show as they are."""
    cases = [one for one in outcomes if one.tier == "K"]
    own = {name for one in cases if one.role == "plain" for name in one.said.effects}
    terms = [one for one in cases if one.role == "term"]
    added = [one for one in cases if one.role == "added"]
    more = [set(one.said.effects) - one.truths - own for one in added]
    return [
        share_score("K", "withheld term named", share(_named(one) for one in terms)),
        share_score("K", "added effect named", share(_named(one) for one in added)),
        share_score("K", "added effect in a set", share(one.covered(one.truth) for one in added)),
        share_score("K", "added effect named first", share(map(named_first, added))),
        share_score("K", "named though neither added nor seen before", share(map(bool, more))),
    ]


def _named(one: Outcome) -> bool:
    return one.truth in one.said.effects
