"""How the report page names causes, and writes shares and p-values."""

from tofcorr.diagnosis.findings.gap import Interval
from tofcorr.diagnosis.findings.shares import HAND_EYE, Share
from tofcorr.diagnosis.sums.study import Study
from tofcorr.simulation.effects import CATALOGUE

# Shares that are written as less than one per cent (no unit): they would round to 0 %.
_SMALL = 0.005
LEAST_SHARE, MOST_SHARE = -1.0, 2.0
"""Ends beyond which the interval of a share is cut off. Chosen: it is not determined then."""
# Relative difference of p-values that counts as none: some were rounded to float32. Chosen.
_ROUNDING = 1e-5


def effect_words(study: Study, name: str) -> str:
    """Return the name of an effect, marked if the base model has a term of that name already."""
    return f"{name} (higher order)" if _refines(study, name) else name


def cause_words(study: Study, share: Share) -> str:
    """Return the name of a cause in an attribution: which kind of term it is."""
    if share.cause == HAND_EYE:
        return "hand-eye transform"
    if share.cause not in CATALOGUE:
        return share.cause
    if share.kind == "parameter":
        return f"{share.cause} (base term)"
    if _refines(study, share.cause) and study.fit.known is not None:
        return f"{share.cause} (base, higher order)"
    return effect_words(study, share.cause)


def _refines(study: Study, name: str) -> bool:
    effect = CATALOGUE.get(name)
    return effect is not None and not study.fit.model.groups.isdisjoint(effect.refines)


def percent(share: float) -> str:
    """Return a share as a whole number of per cent."""
    return f"{round(100 * share):d} %"


def share_words(share: float) -> str:
    """Return a share in per cent; a small one that is there does not read 0 %."""
    return "< 1 %" if 0 < share < _SMALL else percent(share)


def interval_words(interval: Interval) -> str:
    """Return the interval of a share in per cent; its ends are cut off at -100 and 200 %.

    Where a gap is hardly larger than its own uncertainty, causes that cancel one another have
    shares of any size.
    """
    low, high = (min(max(end, LEAST_SHARE), MOST_SHARE) for end in interval)
    ends = (
        f"{'< ' if low > interval[0] else ''}{percent(low)}",
        f"{'> ' if high < interval[1] else ''}{percent(high)}",
    )
    return f"[{', '.join(ends)}]"


def p_words(value: float, least: float) -> str:
    """Return a p-value after `p`, such as `= 0.012`.

    Args:
        value: The p-value.
        least: The smallest that the test can give: it says "at most".
    """
    return f"{'≤' if value <= least * (1 + _ROUNDING) else '='} {value:.3f}"
