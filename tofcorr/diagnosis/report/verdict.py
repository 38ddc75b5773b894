"""The verdict: the gap as given, what it consists of, and what remains, in three sentences."""

from collections.abc import Sequence

from tofcorr.diagnosis.findings.gap import Gap
from tofcorr.diagnosis.findings.naming import NamedEffects
from tofcorr.diagnosis.findings.open_set import OpenSet
from tofcorr.diagnosis.findings.shares import Share
from tofcorr.diagnosis.report.words import effect_words, percent, share_words
from tofcorr.digits import known, known_interval

# Shares below this are not worth a word in the verdict; they stand in the table. Chosen.
_WORTH_A_WORD = 0.01
# Above this share of the squared gap a scatter of the poses explains it. Chosen: most of it.
_MOST_OF_IT = 0.5


def write_verdict(
    named: NamedEffects, gap: Gap, remainder: OpenSet, shares: Sequence[Share]
) -> str:
    """Return the finding in three sentences.

    Args:
        named: The effects named.
        gap: As given, before and after them.
        remainder: What they leave.
        shares: The attribution of the gap.
    """
    made_of = _made_of(gap, remainder, shares, named)
    return " ".join(filter(None, [_size(gap), made_of, _remains(named, gap, remainder)]))


def _size(gap: Gap) -> str:
    bound = " (an upper bound)" if not gap.floor_from_repeats else ""
    over = f"in excess of a noise of {mm(gap.floor)} mm{bound}"
    if gap.as_given is None or gap.as_given_interval is None:
        return (
            "No simulator was given, so one was fitted to the recording; it differs from the "
            f"recording by {sized(gap.before, gap.before_interval)}, {over}."
        )
    return (
        "The simulator as given differs from the recording by "
        f"{sized(gap.as_given, gap.as_given_interval)}, {over}."
    )


def _made_of(gap: Gap, remainder: OpenSet, shares: Sequence[Share], named: NamedEffects) -> str:
    total = gap.before if gap.as_given is None else gap.as_given
    if total <= 0:
        return "That is no more than the noise."
    causes = sorted(
        (one for one in shares if one.kind != "unexplained" and abs(one.share) >= _WORTH_A_WORD),
        key=lambda one: -one.share,
    )
    left = next(one.share for one in shares if one.kind == "unexplained")
    if causes:
        words = ", ".join(f"{one.cause} {percent(one.share)}" for one in causes)
        return f"Shares of its square: {words}; {share_words(left)} is unexplained."
    return "" if named.names else _without_causes(gap, remainder, named)


def _without_causes(gap: Gap, remainder: OpenSet, named: NamedEffects) -> str:
    total, interval = gap.before, gap.before_interval
    if gap.as_given is not None and gap.as_given_interval is not None:
        total, interval = gap.as_given, gap.as_given_interval
    if remainder.unknown:
        return _unexplained(gap, named)
    if named.likeliest:
        return "No cause of it is significant."
    if interval[0] <= 0:
        return "Noise may be all of it."
    if gap.as_given is None and remainder.scatter**2 > _MOST_OF_IT * total**2:
        scatter = mm(remainder.scatter)
        return f"Poses of camera or target that scatter by {scatter} mm would explain it."
    small = total < 1e-3 * named.study.options.target_gap_mm
    size = "That is too small to show a cause."
    return size if small else "None of the effects tested is significant."


def _unexplained(gap: Gap, named: NamedEffects) -> str:
    if gap.as_given is not None:
        return "No parameter and no effect explains it."
    nearest = _nearest(named)
    words = f" (nearest: {nearest})" if nearest else ""
    return f"None of the effects tested explains it{words}."


def _remains(named: NamedEffects, gap: Gap, remainder: OpenSet) -> str:
    after = sized(gap.after, gap.after_interval)
    given = gap.as_given is not None
    if named.names:
        many = listed([effect_words(named.study, name) for name in named.names])
        before = known(1e3 * gap.before, _in_mm(gap.before_interval))
        start = f"Recalibration leaves {before} mm; with " if given else "With "
        sentence = f"{start}{many}{_or_fewer(named)} added, {after} remain"
        if remainder.unknown:
            sentence += ", which none of the effects tested explains."
        else:
            sentence += f": {'calibrate it and add' if given else 'add'} {many}."
        return f"{sentence}{_if_certain(named)}"
    return _nothing_named(named, gap, remainder, after)


def _if_certain(named: NamedEffects) -> str:
    """Say that the first effect is named on less evidence than others are."""
    if not named.certain:
        return ""
    name = effect_words(named.study, named.names[0])
    return (
        f" The gap is significant as a whole, and {name} explains most of it; but {name} would be "
        "significant only if no other effect had been tested. More poses would decide."
    )


def _or_fewer(named: NamedEffects) -> str:
    """Say which of the named effects, of another form, may be the cause of several of them."""
    causes = {
        other
        for name, own in zip(named.names, named.sets, strict=True)
        for other in own.members
        if other != name and other in named.names
    }
    words = [effect_words(named.study, name) for name in named.names if name in causes]
    return f" (or only {' or '.join(words)}, of another form)" if words else ""


def _nothing_named(named: NamedEffects, gap: Gap, remainder: OpenSet, after: str) -> str:
    given = gap.as_given is not None
    start = f"Recalibration leaves {after}" if given else "No effect is named"
    nearest = _nearest(named)
    if remainder.unknown:  # Without a simulator that is said already.
        words = f" (nearest: {nearest})" if nearest else ""
        return f"{start}, and none of the effects tested explains that{words}." if given else ""
    if nearest:
        start += f" (likeliest, but not {'significant' if named.tested else 'tested'}: {nearest})"
    if not named.tested:
        return f"{start}; record more poses, for effects are ranked here and not tested."
    if named.likeliest:
        return f"{start}; record more poses, for these are too few to show which."
    nothing = "no effect is missing that this recording could show"
    if not given:
        return f"{nothing.capitalize()}."
    # A simulator within the noise has nothing to calibrate.
    todo = ": calibrate it" if gap.as_given else ""
    return f"{start}, and {nothing}{todo}."


def _nearest(named: NamedEffects) -> str:
    return ", ".join(effect_words(named.study, name) for name in named.likeliest)


def listed(names: Sequence[str]) -> str:
    """Return names as words: a, b and c."""
    *first, last = names
    return f"{', '.join(first)} and {last}" if first else last


def sized(size: float, interval: tuple[float, float]) -> str:
    """Return a length in metres as millimetres with its interval, in the digits that are known."""
    ends = ", ".join(known_interval(_in_mm(interval)))
    return f"{known(1e3 * size, _in_mm(interval))} mm [{ends}]"


def _in_mm(interval: tuple[float, float]) -> tuple[float, float]:
    return 1e3 * interval[0], 1e3 * interval[1]


def mm(metres: float) -> str:
    """Return millimetres to one decimal."""
    return f"{metres * 1e3:z.1f}"
