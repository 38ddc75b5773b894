"""The finding in one paragraph."""

from collections.abc import Sequence

from tofcorr.diagnosis.findings.how_far import Gap
from tofcorr.diagnosis.findings.select import Selection
from tofcorr.diagnosis.findings.which import absorbed_share
from tofcorr.simulation.effects import CATALOGUE

# More causes than these share a sentence.
_MOST_SENTENCES = 3


def write_verdict(
    selection: Selection,
    gap: Gap,
    *,
    unknown: bool,
    fingerprint: Sequence[str],
    detectable: dict[str, float | None],
    missing: dict[str, list[str]],
) -> str:
    """Return quantity, value, cause, consequence and what cannot be concluded, in sentences."""
    sentences = [_size(gap), _parts(gap)]
    if not selection.tested:
        units = selection.study.blocks.num_units
        sentences.append(
            f"With {units} poses effects are ranked but not tested; "
            f"{selection.study.options.tests.least_images} are needed."
        )
    sentences += _causes(selection)
    if selection.named:
        sentences.append(_closed(gap, len(selection.named)))
    elif selection.tested and not unknown:
        sentences.append(_nothing_found(detectable))
    if selection.taken_up:
        listed = ", ".join(selection.taken_up)
        sentences.append(f"The base model was given a finer form of {listed}, too small to name.")
    if unknown:
        sentences.append("No effect of the catalogue explains what remains.")
        sentences += [f"It {mark}." for mark in fingerprint]
    if missing:
        listed = ", ".join(missing)
        sentences.append(f"Not judged for want of data: {listed}.")
    return " ".join(sentence for sentence in sentences if sentence)


def _size(gap: Gap) -> str:
    bound = "" if gap.floor_from_repeats else " (an upper bound)"
    return (
        f"Simulator and recording part by {_mm(gap.before)} "
        f"[{_mm(gap.before_interval[0])}, {_mm(gap.before_interval[1])}] mm once all parameters "
        f"are refitted, over a noise floor of {_mm(gap.floor)} mm{bound}."
    )


def _parts(gap: Gap) -> str:
    total = gap.before**2
    if total <= 0:
        return ""
    shares = [
        (gap.between_images**2 / total, "lies between images"),
        (gap.fixed_pattern**2 / total, "is the same in every image"),
        (gap.within_images**2 / total, "changes within images"),
    ]
    share, words = max(shares)
    return f"{100 * share:.0f} % of its square {words}."


def _causes(selection: Selection) -> list[str]:
    """Return a sentence for every cause; one for all but the first if they are many."""
    count = len(selection.named)
    if count <= _MOST_SENTENCES:
        return [_cause(selection, position) for position in range(count)]
    further = []
    for position in range(1, count):
        name, others = selection.named[position], _others(selection, position)
        beside = f", not told from {others}" if others else ""
        further.append(f"{name} ({CATALOGUE[name].summary}{beside})")
    return [_cause(selection, 0), f"Further causes, as they were found: {'; '.join(further)}."]


def _cause(selection: Selection, position: int) -> str:
    name, others = selection.named[position], _others(selection, position)
    what = CATALOGUE[name].summary
    sentence = f"{'Cause' if position == 0 else 'Further cause'}: {name} ({what})"
    if others:
        sentence += f", which these data cannot tell from {others}"
    study = selection.study
    if name in study.effects:
        absorbed = absorbed_share(study, name)
        if absorbed > 0.2:
            sentence += f"; calibration takes up about {100 * absorbed:.0f} % of such an effect"
    return sentence + "."


def _others(selection: Selection, position: int) -> str:
    """Return what stands beside a named effect in its set, listed."""
    name = selection.named[position]
    return ", ".join(member for member in selection.sets[position] if member != name)


def _closed(gap: Gap, count: int) -> str:
    sentence = (
        f"Adding {'it' if count == 1 else 'them'} leaves {_mm(gap.after)} "
        f"[{_mm(gap.after_interval[0])}, {_mm(gap.after_interval[1])}] mm "
        f"and closes {100 * gap.closed:.0f} % "
        f"[{100 * gap.closed_interval[0]:.0f}, {100 * gap.closed_interval[1]:.0f}] of the gap."
    )
    if gap.hand_eye_shift[0] > 0:
        sentence += f" The hand-eye translation moves by {_mm(gap.hand_eye_shift[0])} mm."
    return sentence


def _nothing_found(detectable: dict[str, float | None]) -> str:
    known = {name: size for name, size in detectable.items() if size is not None}
    if not known:
        return "No effect was found."
    weakest = max(known, key=lambda name: known[name])
    return (
        "No effect was found; those that can be seen would have been found from "
        f"{_mm(min(known.values()))} to {_mm(known[weakest])} mm ({weakest})."
    )


def _mm(metres: float) -> str:
    return f"{metres * 1e3:.1f}"
