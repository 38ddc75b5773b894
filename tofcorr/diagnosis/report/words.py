"""What the report says in words: names, numbers, the verdict, causes, remarks, and figures."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from tofcorr.conditions import CONDITIONS, condition
from tofcorr.diagnosis.findings.absorption import absorbed_share
from tofcorr.diagnosis.findings.cause_sets import CauseSet
from tofcorr.diagnosis.findings.gap import Gap, Interval, LonePoses
from tofcorr.diagnosis.findings.naming import NamedEffects
from tofcorr.diagnosis.findings.open_set import OpenSet
from tofcorr.diagnosis.findings.shares import HAND_EYE, Share
from tofcorr.diagnosis.findings.where import Region
from tofcorr.diagnosis.rerun.simulator import solution_of
from tofcorr.diagnosis.sums.study import Study
from tofcorr.digits import known, known_interval
from tofcorr.geometry import se3
from tofcorr.simulation.effects import CATALOGUE

if TYPE_CHECKING:
    from tofcorr.diagnosis.report.result import DiagnosisResult

STAGE_WORDS = {
    "as_given": "as given",
    "recalibrated": "recalibrated",
    "with_effects": "with the effects",
}
"""What a stage is called on the page."""
SHARE_ENDS = (-1.0, 2.0)
"""Ends beyond which the interval of a share is cut off. Chosen: it is not determined then."""
SIGNIFICANT = 0.05
"""p-value below which a text speaks of a bias. 5 % by convention."""
# Shares below this are not worth a word (no unit). Chosen: they look as if nothing were there.
_SMALL = 0.05
_STATIC = "is the same in every image"
_LABELS = {
    "distance_m": "distance, m",
    "row": "row, px",
    "column": "column, px",
    "image_radius": "radius in the image (1: edge)",
    "incidence_deg": "incidence angle, deg",
    "amplitude": "amplitude, counts",
    "phase_quarter_deg": "four times the phase, deg",
    **{each.covariate: each.label for each in map(condition, CONDITIONS)},
    "frame": "frame number",
    **{f"{place}_{axis}_m": f"{place} {axis}, m" for place in ("target", "tool") for axis in "xyz"},
}


def effect_words(study: Study, name: str) -> str:
    """Return the name of an effect, marked if the base model has a term of that name already."""
    refined = name in CATALOGUE and not study.fit.model.groups.isdisjoint(CATALOGUE[name].refines)
    return f"{name} (higher order)" if refined else name


def cause_words(study: Study, share: Share) -> str:
    """Return the name of a cause in an attribution: which kind of term it is."""
    if share.cause == HAND_EYE:
        return "hand-eye transform"
    if share.cause in CATALOGUE and share.kind == "parameter":
        return f"{share.cause} (base term)"
    words = effect_words(study, share.cause)
    return words if study.fit.known is None else words.replace("(higher", "(base, higher")


def mm(metres: float) -> str:
    """Return millimetres to one decimal."""
    return f"{metres * 1e3:z.1f}"


def sized(size: float, interval: Interval) -> str:
    """Return a length in metres as millimetres with its interval, in the digits that are known."""
    in_mm = 1e3 * interval[0], 1e3 * interval[1]
    return f"{known(1e3 * size, in_mm)} mm [{', '.join(known_interval(in_mm))}]"


def percent(share: float) -> str:
    """Return a share as a whole number of per cent."""
    return f"{round(100 * share):d} %"


def share_words(share: float) -> str:
    """Return a share in per cent; a small one that is there does not read 0 %."""
    return "< 1 %" if share > 0 and percent(share) == "0 %" else percent(share)


def interval_words(interval: Interval) -> str:
    """Return the interval of a share in per cent; its ends are cut off at -100 and 200 %.

    Where a gap is hardly larger than its own uncertainty, causes that cancel one another have
    shares of any size.
    """
    low, high = (min(max(end, SHARE_ENDS[0]), SHARE_ENDS[1]) for end in interval)
    below, above = "< " if low > interval[0] else "", "> " if high < interval[1] else ""
    return f"[{below}{percent(low)}, {above}{percent(high)}]"


def p_words(value: float, least: float) -> str:
    """Return a p-value after `p`, such as `= 0.012`.

    Args:
        value: The p-value.
        least: The smallest that the test can give: it says "at most".
    """
    # Some p-values were rounded to float32.
    return f"{'≤' if value <= least * (1 + 1e-5) else '='} {value:.3f}"


def write_verdict(
    named: NamedEffects, gap: Gap, remainder: OpenSet, shares: Sequence[Share]
) -> str:
    """Return the finding in three sentences: the gap as given, what it consists of, what remains.

    Args:
        named: The effects named.
        gap: As given, before and after them.
        remainder: What they leave.
        shares: The attribution of the gap.
    """
    start = "The simulator as given"
    if gap.as_given is None:
        start = "No simulator was given, so one was fitted to the recording; it"
    bound = "" if gap.floor_from_repeats else " (an upper bound)"
    size = (
        f"{start} differs from the recording by {sized(*_whole(gap))}, in excess of a noise of "
        f"{mm(gap.floor)} mm{bound}."
    )
    made_of = _made_of(named, gap, remainder, shares)
    return " ".join(filter(None, [size, made_of, _remains(named, gap, remainder)]))


def _whole(gap: Gap) -> tuple[float, Interval]:
    """Return the gap to the simulator under diagnosis, or to the one fitted, and its interval."""
    if gap.as_given is None or gap.as_given_interval is None:
        return gap.before, gap.before_interval
    return gap.as_given, gap.as_given_interval


def _made_of(named: NamedEffects, gap: Gap, remainder: OpenSet, shares: Sequence[Share]) -> str:
    if _whole(gap)[0] <= 0:
        return "That is no more than the noise."
    causes = [s for s in shares if s.kind != "unexplained" and abs(s.share) >= 1 / 100]
    if causes:
        words = [f"{one.cause} {percent(one.share)}" for one in _ordered(causes)]
        left = next(one.share for one in shares if one.kind == "unexplained")
        return f"Shares of its square: {', '.join(words)}; {share_words(left)} is unexplained."
    return "" if named.names else _without_causes(named, gap, remainder)


def _without_causes(named: NamedEffects, gap: Gap, remainder: OpenSet) -> str:
    total, interval = _whole(gap)
    if remainder.unknown and gap.as_given is not None:
        return "No parameter and no effect explains it."
    if remainder.unknown:
        return f"None of the effects tested explains it{_nearest(named)}."
    if named.likeliest:
        return "No cause of it is significant."
    if interval[0] <= 0:
        return "Noise may be all of it."
    if gap.as_given is None and remainder.scatter**2 > 0.5 * total**2:
        scatter = mm(remainder.scatter)
        return f"Poses of camera or target that scatter by {scatter} mm would explain it."
    small = total < 1e-3 * named.study.options.target_gap_mm
    size = "That is too small to show a cause."
    return size if small else "None of the effects tested is significant."


def _ordered(shares: Sequence[Share]) -> list[Share]:
    """Return shares, the largest first."""
    return sorted(shares, key=lambda one: -one.share)


def _nearest(named: NamedEffects, what: str = "nearest") -> str:
    words = ", ".join(effect_words(named.study, name) for name in named.likeliest)
    return f" ({what}: {words})" if words else ""


def _remains(named: NamedEffects, gap: Gap, remainder: OpenSet) -> str:
    after = sized(gap.after, gap.after_interval)
    given = gap.as_given is not None
    if not named.names:
        return _nothing_named(named, gap, remainder, after)
    *first, last = [effect_words(named.study, name) for name in named.names]
    many = f"{', '.join(first)} and {last}" if first else last
    start = f"Recalibration leaves {sized(gap.before, gap.before_interval).split(' [')[0]}; with "
    sentence = f"{start if given else 'With '}{many}{_or_fewer(named)} added, {after} remain"
    if remainder.unknown:
        sentence += ", which none of the effects tested explains."
    else:
        sentence += f": {'calibrate it and add' if given else 'add'} {many}."
    if not named.certain:
        return sentence
    name = effect_words(named.study, named.names[0])
    return (
        f"{sentence} The gap is significant as a whole, and {name} explains most of it; but {name} "
        "would be significant only if no other effect had been tested. More poses would decide."
    )


def _or_fewer(named: NamedEffects) -> str:
    """Say which of the named effects, of another form, may be the cause of several of them."""
    sets = zip(named.names, named.sets, strict=True)
    causes = {other for name, own in sets for other in own.members if other != name}
    words = [effect_words(named.study, name) for name in named.names if name in causes]
    return f" (or only {' or '.join(words)}, of another form)" if words else ""


def _nothing_named(named: NamedEffects, gap: Gap, remainder: OpenSet, after: str) -> str:
    given = gap.as_given is not None
    start = f"Recalibration leaves {after}" if given else "No effect is named"
    if remainder.unknown:  # Without a simulator that is said already.
        explained = f", and none of the effects tested explains that{_nearest(named)}."
        return start + explained if given else ""
    start += _nearest(named, f"likeliest, but not {'significant' if named.tested else 'tested'}")
    if not named.tested:
        return f"{start}; record more poses, for effects are ranked here and not tested."
    if named.likeliest:
        return f"{start}; record more poses, for these are too few to show which."
    nothing = "no effect is missing that this recording could show"
    if not given:
        return f"{nothing.capitalize()}."
    # A simulator within the noise has nothing to calibrate.
    return f"{start}, and {nothing}{': calibrate it' if gap.as_given else ''}."


def list_causes(study: Study, named: NamedEffects, shares: Sequence[Share]) -> tuple[str, ...]:
    """Return a line for each cause, the largest share first."""
    # A parameter that was left as the simulator has it causes nothing.
    causes = (one for one in shares if one.kind == "effect" or one.share or any(one.interval))
    known_causes = [one for one in causes if one.kind != "unexplained"]
    return tuple(_cause_line(study, named, one) for one in _ordered(known_causes))


def _cause_line(study: Study, named: NamedEffects, one: Share) -> str:
    line = f"{cause_words(study, one)}: {share_words(one.share)} {interval_words(one.interval)}"
    line += " of the squared gap"
    if one.of_constant is not None and one.of_constant > _SMALL:
        line += f" ({percent(one.of_constant)} by a constant offset, which any cause may have)"
    if one.kind == "effect":
        return f"{line}; {effect_line(named, one.cause)}."
    if one.cause != HAND_EYE or study.fit.known is None:
        return f"{line}; a parameter of the simulator's error model."
    given = study.fit.known.tool_from_camera
    moved = se3.log(se3.inverse(given) @ solution_of(study, named)[0])
    return (
        f"{line}; the camera sits {mm(float(moved[:3].norm()))} mm and "
        f"{math.degrees(float(moved[3:].norm())):.2f} degrees from where the simulator has it."
    )


def effect_line(named: NamedEffects, name: str) -> str:
    """Return what a named effect is, what it may be instead, and what hides it."""
    words = CATALOGUE[name].summary
    if not named.study.fit.model.groups.isdisjoint(CATALOGUE[name].refines):
        words = f"the base model's {name} term, and a higher-order form of it"
    own = named.sets[named.names.index(name)]
    others = [member for member in own.members if member != name]
    rivals = [_rival(named, own, member) for member in others if member not in named.names]
    if rivals:
        words += f", which these data cannot distinguish from {', '.join(rivals)}"
    causes = [effect_words(named.study, member) for member in others if member in named.names]
    if causes:
        words += f"; it may be an error in the form of {' or '.join(causes)}"
    if name in named.study.candidates.effects:
        absorbed = absorbed_share(named.study, name)
        if absorbed > 0.2:
            words += f"; calibration absorbs about {percent(absorbed)} of such an effect"
    return words


def _rival(named: NamedEffects, own: CauseSet, member: str) -> str:
    """Return another member of a cause set, with what it closes in the place of the named one."""
    share = own.closes.get(member, 0.0)
    closes = f" (closes {percent(share)} of what this one closes)" if share >= _SMALL else ""
    return effect_words(named.study, member) + closes


def list_remarks(
    named: NamedEffects,
    gap: Gap,
    alone: LonePoses | None,
    remainder: OpenSet,
    detectable: Mapping[str, float | None],
    missing: Sequence[str],
) -> tuple[str, ...]:
    """Return what else must be said, a sentence or two each.

    Args:
        named: The effects named.
        gap: Before and after them.
        alone: Poses that make most of the gap because no other pose predicts them; None: none do.
        remainder: What they leave.
        detectable: The smallest size of each effect that would have been found, metres.
        missing: Untestable effects.
    """
    remarks = ["" if alone is None else _alone(alone), _largest_component(gap, named)]
    if not named.tested:
        remarks.append(
            f"With {named.study.sums.num_units} poses effects are ranked but not tested; "
            f"a test needs {named.study.options.tests.least_images}."
        )
    if named.names:
        remarks.append(_closed(gap))
    elif named.tested and not remainder.unknown:
        remarks.append(_nothing_found(detectable))
    if len(named.refined_terms) == 1:
        (term,) = named.refined_terms
        remarks.append(f"A higher-order {term} term was added; too small to report.")
    elif named.refined_terms:
        terms = ", ".join(named.refined_terms)
        remarks.append(f"Higher-order terms of {terms} were added; too small to report.")
    small = remainder.scatter < named.study.options.target_gap_mm * 1e-3 / 2
    if named.tested and not remainder.unknown and not small:
        remarks.append(
            f"The poses of camera or target scatter by {mm(remainder.scatter)} mm, which depends "
            "on nothing recorded: a robot or a survey of that repeatability explains it."
        )
    remarks.append(moving_waves(named.study))
    if remainder.unknown and remainder.fingerprint:
        first, *more = remainder.fingerprint
        remarks.append(
            " ".join([f"The gap that remains {first}.", *(f"It {clause}." for clause in more)])
        )
    if missing:
        remarks.append(f"Not tested (missing data): {', '.join(missing)}.")
    return tuple(filter(None, remarks))


def _alone(poses: LonePoses) -> str:
    """Say that the gap is large because the recording says too little."""
    frames, (near, far) = poses.frames, poses.distance
    first, makes, these = f"Frame {frames[0]}", "makes", "this one"
    if len(frames) > 1:
        first = f"{len(frames)} poses, such as that of frame {frames[0]}"
        makes, these = "make", "these"
    return (
        f"{first}, at {near:.1f} to {far:.1f} m, {makes} {percent(poses.share)} of the squared gap:"
        f" the gap is what a fit to all other poses misses, and no other pose is like {these}. The "
        f"others make {mm(poses.others)} mm. Record more poses there."
    )


def _largest_component(gap: Gap, named: NamedEffects) -> str:
    # What noise may be all of, or is printed as 0.0 mm, is not shared out.
    if float(mm(gap.before_interval[0])) == 0:
        return ""
    size, words = max(
        (gap.between_images, "shifts or tilts whole images"),
        (gap.fixed_pattern, _STATIC),
        (
            gap.within_images,
            "varies within images, from image to image, or between the frames of a pose",
        ),
    )
    share = size**2 / gap.before**2
    sentence = f"After recalibration {percent(share)} of the squared gap {words}"
    # Its cause need not be known to be corrected.
    if words == _STATIC and not named.maps and share > 0.5:
        sentence += ": whatever its cause, a table of one offset for each pixel corrects it"
    return f"{sentence}."


def moving_waves(study: Study) -> str:
    """Say that waves which change from frame to frame count as noise in part; else nothing."""
    if not study.fit.shared.striped:
        return ""
    return (
        "An error that changes from frame to frame, such as waves that move, reaches farther over "
        "the image than a filter does. Where it differs between neighbouring pixels, it counts as "
        "noise."
    )


def _closed(gap: Gap) -> str:
    sentence = (
        f"The effects close {percent(gap.closed)} {interval_words(gap.closed_interval)} of the "
        "squared gap that recalibration leaves."
    )
    if gap.closed_interval[0] <= 0:
        sentence += " Whether they help at all is not certain."
    if gap.hand_eye_shift[0] > 0:
        shift = mm(gap.hand_eye_shift[0])
        sentence += f" With them the hand-eye translation changes by {shift} mm."
    return sentence


def _nothing_found(detectable: Mapping[str, float | None]) -> str:
    sizes = {name: size for name, size in detectable.items() if size is not None}
    if not sizes:
        return "No effect was found."
    weakest = max(sizes, key=lambda name: sizes[name])
    return (
        "No effect was found. The smallest effects that would have been detected are between "
        f"{mm(min(sizes.values()))} and {mm(sizes[weakest])} mm ({weakest})."
    )


def most_biased(groups: Mapping[str, Sequence[Region]]) -> list[tuple[str, Sequence[Region]]]:
    """Return covariates and their regions: the most significant first, then the widest range."""

    def order(item: tuple[str, Sequence[Region]]) -> tuple[float, float]:
        biases = biases_of(item[1]) or [0.0]
        return min(region.p_value for region in item[1]), min(biases) - max(biases)

    return sorted(groups.items(), key=order)


def biases_of(regions: Sequence[Region]) -> list[float]:
    """Return the bias of each bin of a covariate, metres."""
    return [region.bias for region in regions if not region.trend]


def _along(covariate: str, regions: Sequence[Region]) -> str:
    """Return how the bias goes along a covariate; empty without a bin."""
    biases, name = biases_of(regions), axis_label(covariate).split(",")[0]
    return f"{name} it goes from {mm(min(biases))} to {mm(max(biases))} mm" if biases else ""


def axis_label(covariate: str) -> str:
    """Return what a covariate is called on an axis, with its unit after a comma."""
    return _LABELS.get(covariate, covariate)


Finding = tuple[str, str]
"""What a figure shows in this diagnosis: a sentence or two, and what its bars or dots are."""


def _stages(result: "DiagnosisResult") -> Finding:
    sizes = ", ".join(
        f"{STAGE_WORDS[one.name]} {sized(one.gap, one.interval)}"
        for one in result.stages_known
        if one.gap is not None and one.interval is not None
    )
    finding = f"The simulator differs from the recording by: {sizes}."
    if result.stages[0].gap is None:
        finding = f"No simulator was given; one was fitted. It differs by: {sizes}."
    if result.degraded is not None:
        degraded = sized(result.degraded.gap, result.degraded.interval)
        finding += f" Ideal frames, degraded: {degraded}."
    return finding, sizes


def _attribution(result: "DiagnosisResult") -> Finding:
    study = result.evidence.study
    shares = [f"{cause_words(study, one)} {share_words(one.share)}" for one in result.shares]
    causes = [one for one in result.shares if one.kind != "unexplained"]
    finding = "No cause was found."
    if any(one.share for one in causes):
        largest = _ordered(causes)[0]
        finding = f"The largest cause is {cause_words(study, largest)} with "
        finding += f"{share_words(largest.share)}."
    if any(one.share < 0 and percent(one.share) != "0 %" for one in causes):
        finding += " A cause with a negative share cancels part of another."
    closing = {entry.name: entry.closed_fraction for entry in result.ranking}
    effects = [one for one in causes if one.kind == "effect" and one.cause in closing]
    if any(abs(one.share) < _SMALL for one in effects) and result.stages[0].gap is not None:
        each = [f"{effect_words(study, e.cause)} {share_words(closing[e.cause])}" for e in effects]
        finding += (
            " Effects are named for what recalibration leaves; of the square of that gap they "
            f"close, each alone: {', '.join(each)}."
        )
    return finding, ", ".join(shares)


def _where_as_given(result: "DiagnosisResult") -> Finding:
    where = result.stages[0].found_where
    finding = f"As given, the mean residual is {mm(float(where.offsets.mean()))} mm."
    along = _along(*most_biased(where.by_covariate())[0])
    return f"{finding} Along {along}." if along else finding, ""


def _where(result: "DiagnosisResult") -> Finding:
    strips = most_biased(result.where.by_covariate())
    if not strips or min(region.p_value for region in strips[0][1]) > SIGNIFICANT:
        return "After recalibration, the bias depends on no covariate at the 5 % level.", ""
    covariate, regions = strips[0]
    along = _along(covariate, regions).replace(" it goes", ": it goes")
    if not along:
        along = f"{axis_label(covariate).split(',')[0]}: it goes by {mm(regions[0].bias)} mm"
    return f"After recalibration, the bias is clearest along {along}.", ""


def _map(result: "DiagnosisResult") -> Finding:
    found = [
        f"{STAGE_WORDS[one.name]} {int((one.found_where.tile_p_values <= SIGNIFICANT).sum())}"
        for one in result.stages_known
    ]
    tiles = int(np.isfinite(result.where.tiles).sum())
    sentence = f"Tiles that differ from zero, of {tiles} with data: {', '.join(found)}."
    return sentence, str(len(found))


def _series(result: "DiagnosisResult") -> Finding:
    spread = [
        f"{STAGE_WORDS[one.name]} {mm(float(one.found_where.offsets.std()))} mm"
        for one in result.stages_fitted
    ]
    return f"Standard deviation of the poses' means: {', '.join(spread)}.", ""


def _poses(result: "DiagnosisResult") -> Finding:
    if not result.effects:
        return "No effect is named, so all poses lie on the line.", ""
    before, after = result.evidence.pose_errors
    better = int((after < before).sum())
    return f"The effects bring {better} of {len(before)} held-out poses nearer.", ""


FINDINGS: dict[str, Callable[["DiagnosisResult"], Finding]] = {
    "stages": _stages,
    "attribution": _attribution,
    "where_as_given": _where_as_given,
    "where": _where,
    "map": _map,
    "series": _series,
    "poses": _poses,
}
"""What figures show that `diagnosis.json` does not say; the page's template words the others."""
