"""The verdict: the finding in one paragraph."""

from collections.abc import Mapping, Sequence

from tofcorr.diagnosis.findings.absorption import absorbed_share
from tofcorr.diagnosis.findings.how_far import Gap
from tofcorr.diagnosis.findings.naming import NamedEffects
from tofcorr.diagnosis.findings.open_set import OpenSet
from tofcorr.simulation.effects import CATALOGUE

# Up to this many causes get a sentence each; more share one.
_MOST_SENTENCES = 3
# Above this share the verdict says how much of an effect the calibration absorbs. Chosen.
_WORTH_SAYING = 0.2


def write_verdict(
    named: NamedEffects,
    gap: Gap,
    remainder: OpenSet,
    detectable: Mapping[str, float | None],
    missing: Sequence[str],
) -> str:
    """Return quantity, value, cause, consequence and what cannot be concluded, in sentences.

    Args:
        named: The effects named.
        gap: Before and after them.
        remainder: What they leave.
        detectable: The smallest size of each effect that would have been found, metres.
        missing: Untestable effects.
    """
    sentences = [_size(gap), _largest_component(gap)]
    if not named.tested:
        poses = named.study.system.blocks.num_units
        sentences.append(
            f"With {poses} poses effects are ranked but not tested; a test needs "
            f"{named.study.options.tests.least_images}."
        )
    sentences += _causes(named)
    if named.names:
        sentences.append(_closed(gap, len(named.names)))
    elif named.tested and not remainder.unknown:
        sentences.append(_nothing_found(detectable))
    if named.refined_terms:
        sentences.append(_refined(named.refined_terms))
    if remainder.unknown:
        sentences.append("No effect of the catalogue explains the gap that remains.")
        sentences += [f"It {clause}." for clause in remainder.fingerprint]
    if missing:
        sentences.append(f"Not tested (missing data): {', '.join(missing)}.")
    return " ".join(sentence for sentence in sentences if sentence)


def _size(gap: Gap) -> str:
    bound = " (an upper bound)" if not gap.floor_from_repeats else ""
    return (
        f"Simulator and recording differ by {_mm(gap.before)} "
        f"[{_mm(gap.before_interval[0])}, {_mm(gap.before_interval[1])}] mm after all parameters "
        f"are refitted, in excess of a noise floor of {_mm(gap.floor)} mm{bound}."
    )


def _largest_component(gap: Gap) -> str:
    total = gap.before**2
    if total <= 0:
        return ""
    shares = [
        (gap.between_images**2 / total, "lies between images"),
        (gap.fixed_pattern**2 / total, "is the same in every image"),
        (gap.within_images**2 / total, "changes within images"),
    ]
    share, words = max(shares)
    return f"{100 * share:.0f} % of the squared gap {words}."


def _causes(named: NamedEffects) -> list[str]:
    """Return a sentence for every cause; many causes after the first share one."""
    count = len(named.names)
    if count <= _MOST_SENTENCES:
        return [_cause(named, position) for position in range(count)]
    further = []
    for position in range(1, count):
        name, others = named.names[position], _others(named, position)
        beside = f", indistinguishable from {others}" if others else ""
        further.append(f"{name} ({CATALOGUE[name].summary}{beside})")
    return [_cause(named, 0), f"Further causes, in the order found: {'; '.join(further)}."]


def _cause(named: NamedEffects, position: int) -> str:
    name, others = named.names[position], _others(named, position)
    what = CATALOGUE[name].summary
    sentence = f"{'Cause' if position == 0 else 'Further cause'}: {name} ({what})"
    if others:
        sentence += f", which these data cannot distinguish from {others}"
    study = named.study
    if name in study.candidates.effects:
        absorbed = absorbed_share(study, name)
        if absorbed > _WORTH_SAYING:
            sentence += f"; calibration absorbs about {100 * absorbed:.0f} % of such an effect"
    return sentence + "."


def _others(named: NamedEffects, position: int) -> str:
    """Return the other effects of a cause set, listed."""
    name = named.names[position]
    return ", ".join(member for member in named.cause_sets[position] if member != name)


def _closed(gap: Gap, count: int) -> str:
    sentence = (
        f"Adding {'it' if count == 1 else 'them'} leaves {_mm(gap.after)} "
        f"[{_mm(gap.after_interval[0])}, {_mm(gap.after_interval[1])}] mm "
        f"and closes {100 * gap.closed:.0f} % [{100 * gap.closed_interval[0]:.0f}, "
        f"{100 * gap.closed_interval[1]:.0f}] of the squared gap."
    )
    if gap.hand_eye_shift[0] > 0:
        sentence += f" The hand-eye translation changes by {_mm(gap.hand_eye_shift[0])} mm."
    return sentence


def _refined(names: Sequence[str]) -> str:
    if len(names) == 1:
        return f"A higher-order {names[0]} term was added; too small to report."
    return f"Higher-order terms of {', '.join(names)} were added; too small to report."


def _nothing_found(detectable: Mapping[str, float | None]) -> str:
    known = {name: size for name, size in detectable.items() if size is not None}
    if not known:
        return "No effect was found."
    weakest = max(known, key=lambda name: known[name])
    return (
        "No effect was found. The smallest effects that would have been detected are between "
        f"{_mm(min(known.values()))} and {_mm(known[weakest])} mm ({weakest})."
    )


def _mm(metres: float) -> str:
    return f"{metres * 1e3:.1f}"
