"""What the report says in words: names, numbers, the verdict, causes, remarks, and figures."""

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from tofcorr.conditions import CONDITIONS, condition
from tofcorr.diagnosis.findings.gap import Gap, OpenSet
from tofcorr.diagnosis.findings.naming import NamedEffects
from tofcorr.diagnosis.findings.shares import HAND_EYE, Share, alike
from tofcorr.diagnosis.findings.where import Estimated, Interval, Region, Stage
from tofcorr.diagnosis.rerun.simulator import Evidence
from tofcorr.diagnosis.sums.observations import TINY
from tofcorr.diagnosis.sums.study import Study, absorbed_share
from tofcorr.digits import aligned, known, known_interval
from tofcorr.estimation.robust import LEVEL
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
# Shares below this are not worth a word (no unit). Chosen: they look as if nothing were there.
SMALL = 0.05
_LABELS = {
    "distance_m": "distance, m",
    "row": "row, px",
    "column": "column, px",
    "image_radius": "radius in the image (1: edge)",
    "incidence_deg": "incidence angle, deg",
    "amplitude": "amplitude, counts",
    "phase_quarter_deg": "four times the phase, deg",
    **{each.covariate: each.label for each in map(condition, CONDITIONS)},
    **{f"{place}_{axis}_m": f"{place} {axis}, m" for place in ("target", "tool") for axis in "xyz"},
}


def effect_words(study: Study, name: str) -> str:
    """Return the name of an effect, marked if the base model has a term of that name already."""
    refined = name in CATALOGUE and not study.fit.model.groups.isdisjoint(CATALOGUE[name].refines)
    return f"{name} (higher order)" if refined else name


def cause_words(study: Study, cause: Share) -> str:
    """Return the name of a cause in an attribution: which kind of term it is."""
    if cause.cause == HAND_EYE:
        return "hand-eye transform"
    if cause.cause in CATALOGUE and cause.kind == "parameter":
        return f"{cause.cause} (base term)"
    words = effect_words(study, cause.cause)
    return words if study.fit.known is None else words.replace("(higher", "(base, higher")


def mm(metres: float) -> str:
    """Return millimetres to one decimal."""
    return f"{metres * 1e3:z.1f}"


def sized(size: Estimated) -> str:
    """Return a length in metres as millimetres with its interval, in the digits that are known."""
    in_mm = 1e3 * size.interval[0], 1e3 * size.interval[1]
    return f"{known(1e3 * size, in_mm)} mm [{', '.join(known_interval(in_mm))}]"


def stages_shown(result: "DiagnosisResult", *, fitted: bool = False) -> list[Stage]:
    """Return the stages that differ: no first one without simulator, no last without effects.

    Args:
        result: What was found.
        fitted: Whether only those from recalibration on are wanted.
    """
    stages = result.stages if result.effects else result.stages[:2]
    return [stage for stage in stages[fitted:] if stage.gap is not None]


def table_of_stages(result: "DiagnosisResult") -> list[str]:
    """Return the gap at each stage with its interval, and the noise beside it, a line each."""
    rows = []
    for one in stages_shown(result):
        if one.gap is not None:
            size, interval = sized(one.gap).split(" [")
            rows.append((STAGE_WORDS[one.name], size, f"[{interval}"))
    bound = "" if result.gap.floor_from_repeats else "(an upper bound)"
    return aligned([*rows, ("noise of a pixel", f"{mm(result.gap.floor)} mm", bound)])


def pose_errors(result: "DiagnosisResult") -> tuple[np.ndarray, np.ndarray]:
    """Return the held-out error of each pose before and after the effects, (U,) each, metres."""
    study, named = result.evidence.study, result.evidence.named
    squares = study.left_out_squares(()), named.study.left_out_squares(named.columns)
    count = study.sums.count.clamp(min=TINY)
    before, after = ((own / count).clamp(min=0.0).sqrt().numpy() for own in squares)
    return before, after


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
    return f"{'≤' if value <= least else '='} {value:.3f}"


def write_verdict(
    named: NamedEffects, gap: Gap, remainder: OpenSet, causes: Sequence[Share]
) -> str:
    """Return the finding in three sentences: the gap as given, what it consists of, what remains.

    Args:
        named: The effects named.
        gap: As given, before and after them.
        remainder: What they leave.
        causes: The attribution of the gap.
    """
    start = "The simulator as given"
    if gap.as_given is None:
        start = "No simulator was given, so one was fitted to the recording; it"
    bound = "" if gap.floor_from_repeats else " (an upper bound)"
    size = (
        f"{start} differs from the recording by {sized(gap.whole)}, in excess "
        f"of a noise of {mm(gap.floor)} mm{bound}."
    )
    shares = {one.cause: one.share for one in causes if abs(one.share) >= 1 / 100}
    left = next(one.share for one in causes if one.kind == "unexplained")
    shares.pop("unexplained", None)
    made_of = ""
    if gap.whole <= 0:
        made_of = "That is no more than the noise."
    elif shares:
        words = [f"{n} {percent(shares[n])}" for n in sorted(shares, key=lambda n: -shares[n])]
        made_of = f"Shares of its square: {', '.join(words)}; {share_words(left)} is unexplained."
    elif not named.names:
        made_of = _without_causes(named, gap, remainder)
    remains = _something_named if named.names else _nothing_named
    return " ".join(filter(None, [size, made_of, remains(named, gap, remainder)]))


def _without_causes(named: NamedEffects, gap: Gap, remainder: OpenSet) -> str:
    poses = gap.as_given is None and remainder.scatter**2 > 0.5 * gap.whole**2
    scatter = f"Poses of camera or target that scatter by {mm(remainder.scatter)} mm"
    small = gap.whole < named.study.options.target_gap_mm / 1000
    said = (
        (remainder.unknown and gap.as_given is not None, "No parameter and no effect explains it."),
        (remainder.unknown, f"None of the effects tested explains it{_nearest(named)}."),
        (gap.whole.interval[0] <= 0, "It may be noise alone."),
        (poses, f"{scatter} would explain it."),
        (small, "That is too small to show a cause."),
        (True, "None of the effects tested is probable."),
    )
    return next(sentence for holds, sentence in said if holds)


def probable(probability: float) -> str:
    """Return a probability in words, and as a number."""
    words = ((0.95, "almost surely"), (0.8, "very probably"), (0.5, "probably"))
    said = next((word for least, word in words if probability >= least), "possibly")
    return f"{said} (probability {probability:.2f})"


def _nearest(named: NamedEffects) -> str:
    """Return what is most probable where nothing is named: at most three effects above 10 %."""
    likely = [
        f"{effect_words(named.study, name)} {probability:.2f}"
        for name, probability in named.probabilities.items()
        if name in CATALOGUE and probability >= 1 / 10
    ]
    return f" (most probable: {', '.join(likely[:3])})" if likely else ""


def _something_named(named: NamedEffects, gap: Gap, remainder: OpenSet) -> str:
    *first, last = (effect_words(named.study, name) for name in named.names)
    many = f"{', '.join(first)} and {last}" if first else last
    start, advice = "With ", "add"
    if gap.as_given is not None:
        before = sized(gap.before).split(" [")[0]
        start, advice = f"Recalibration leaves {before}; with ", "calibrate it and add"
    end = f": {advice} {many}"
    rivals = {other for name in named.names for other in named.sets[name]}.difference(named.names)
    if rivals:
        others = ", ".join(effect_words(named.study, name) for name in sorted(rivals))
        end += f", or what these data cannot tell it from ({others})"
    if remainder.unknown:
        end = ", which none of the effects tested explains"
    return f"{start}{many} added, {sized(gap.after)} remain{end}."


def _nothing_named(named: NamedEffects, gap: Gap, remainder: OpenSet) -> str:
    given, start = gap.as_given is not None, "No effect is named"
    if given:
        start = f"Recalibration leaves {sized(gap.after)}"
    if remainder.unknown:  # Without a simulator that is said already.
        explained = f", and none of the effects tested explains that{_nearest(named)}."
        return start + explained if given else ""
    start += _nearest(named)
    if not named.tested:
        return f"{start}; record more poses, for with so few effects are ranked only."
    if named.anything > named.study.options.tests.named_from:
        return f"{start}; something is {probable(named.anything)} missing: record more poses."
    nothing = "no effect is missing that this recording could show"
    if not given:
        return f"{nothing.capitalize()}."
    # A simulator within the noise has nothing to calibrate.
    return f"{start}, and {nothing}{': calibrate it' if gap.as_given else ''}."


def list_causes(found: Evidence, causes: Sequence[Share]) -> tuple[str, ...]:
    """Return a line for each cause, the largest share first."""
    # A parameter that causes nothing is in the picture alone.
    shown = (one for one in causes if one.kind == "effect" or round(100 * one.share))
    ordered = sorted(shown, key=lambda one: -one.share)
    return tuple(_cause_line(found, one) for one in ordered if one.kind != "unexplained")


def _cause_line(found: Evidence, one: Share) -> str:
    share = f"{share_words(one.share)} {interval_words(one.share.interval)}"
    line = f"{cause_words(found.study, one)}: {share} of the squared gap"
    if one.of_constant is not None and one.of_constant > SMALL:
        line += f" ({percent(one.of_constant)} by a constant offset, which any cause may have)"
    known = found.study.fit.known
    if known is not None and one.share > SMALL and (others := alike(found.study, one.cause)):
        same = [cause_words(found.study, Share(other, "effect")) for other in others]
        line += f", or of the {' or the '.join(same)}, which looks the same here"
    if one.kind == "effect":
        return f"{line}; {effect_line(found.named, one.cause)}."
    if one.cause != HAND_EYE or known is None:
        return f"{line}; a parameter of the simulator's error model."
    moved = known.twist_to(found.tool_from_camera)
    return (
        f"{line}; the camera sits {mm(float(moved[:3].norm()))} mm and "
        f"{math.degrees(float(moved[3:].norm())):.2f} degrees from where the simulator has it."
    )


def effect_line(named: NamedEffects, name: str) -> str:
    """Return what a named effect is, what it may be instead, and what hides it."""
    study = named.study
    words = study.effects[name].said if name in study.effects else CATALOGUE[name].summary
    if not study.fit.model.groups.isdisjoint(CATALOGUE[name].refines):
        words = f"the base model's {name} term, and a higher-order form of it"
    rivals = [
        f"{effect_words(study, other)} ({share:.2f})"
        for other, share in named.sets[name].items()
        if other != name
    ]
    if rivals:
        own = f"{named.sets[name][name]:.2f}"
        words += f"; these data cannot tell it ({own}) from {', '.join(rivals)}"
    there = probable(named.probability_of_any(*named.sets[name]))
    words += f"; {'one of them' if rivals else 'it'} is {there} there"
    absorbed = absorbed_share(study, name) if name in study.effects else 0.0
    if absorbed > 0.2:
        words += f"; calibration absorbs about {percent(absorbed)} of such an effect"
    return words


def list_remarks(
    found: Evidence, gap: Gap, remainder: OpenSet, detectable: Mapping[str, float | None]
) -> tuple[str, ...]:
    """Return what else must be said, a sentence or two each.

    Args:
        found: The final model.
        gap: Before and after the effects.
        remainder: What they leave.
        detectable: The smallest size of each effect that would have been found, metres.
    """
    study, named = found.study, found.named
    options = study.options
    remarks = [lone_poses(study, gap.floor), _largest_component(gap, named)]
    if not named.tested:
        remarks.append(
            f"With {study.observations.num_units} poses effects are ranked and none is named; that "
            f"needs {options.tests.least_images}."
        )
    if named.names:
        remarks.append(_closed(gap))
    elif named.tested and not remainder.unknown:
        remarks.append(_nothing_found(detectable))
    small = remainder.scatter < options.target_gap_mm / 2000
    if named.tested and not remainder.unknown and not small:
        remarks.append(
            f"The poses of camera or target scatter by {mm(remainder.scatter)} mm, which depends "
            "on nothing recorded: a robot or a survey of that repeatability explains it."
        )
    remarks.append(moving_waves(named.study))
    if remainder.unknown and remainder.fingerprint:
        first, *more = remainder.fingerprint
        clauses = [f"The gap that remains {first}.", *(f"It {clause}." for clause in more)]
        remarks.append(" ".join(clauses))
    if study.missing:
        remarks.append(f"Not tested (missing data): {', '.join(study.missing)}.")
    return tuple(filter(None, remarks))


def lone_poses(study: Study, floor: float, *, alone_limit: float = 8.0, most: float = 0.5) -> str:
    """Say which poses make most of the base model's gap because they are alone; else nothing.

    Args:
        study: The recording, before any effect was named.
        floor: Noise of a pixel that is no gap, metres.
        alone_limit: A pose is alone if a fit to all others misses it by so many times the mean
            square that the fit to all poses leaves in it. Chosen: with 20 poses that are alike the
            ratio is below 3.
        most: Share of the squared gap, at least, that such poses make where they are worth a line.
            Chosen.
    """
    square, count, ols = study.left_out_squares(()), study.sums.count, study.sums.ols
    alone = square > alone_limit * ols.squares_at((), ols.solve(()).expand(len(count), -1))
    beyond = square - floor**2 * count
    gap = float(beyond.sum())
    share = float(beyond[alone].sum()) / gap if gap > 0 else 0.0
    if not share > most or bool(alone.all()):
        return ""
    others = max(float(beyond[~alone].sum() / count[~alone].sum()), 0.0) ** 0.5
    distance = study.inputs.radial_distance[alone[study.unit_of_pixel]]
    frame = int(alone[study.observations.unit].nonzero()[0])
    return (
        f"{int(alone.sum())} of {len(alone)} poses, with frame {frame} and at "
        f"{float(distance.min()):.1f} to {float(distance.max()):.1f} m, hold "
        f"{percent(min(share, 1.0))} of the squared gap: the gap is what a fit to all other poses "
        f"misses, and there is no other pose there. The others make {mm(others)} mm. Record more "
        "poses there."
    )


def _largest_component(gap: Gap, named: NamedEffects) -> str:
    # What noise may be all of, or is printed as 0.0 mm, is not shared out.
    if float(mm(gap.before.interval[0])) == 0:
        return ""
    size, words = max(
        (gap.between_images, "shifts or tilts whole images"),
        (gap.fixed_pattern, "is the same in every image"),
        (
            gap.within_images,
            "varies within images, from image to image, or between the frames of a pose",
        ),
    )
    share, table = size**2 / gap.before**2, ""
    # Its cause need not be known to be corrected.
    if size == gap.fixed_pattern and not named.maps and share > 0.5:
        table = ": whatever its cause, a table of one offset for each pixel corrects it"
    return f"After recalibration {percent(share)} of the squared gap {words}{table}."


def moving_waves(study: Study) -> str:
    """Say that waves which change from frame to frame count as noise in part; else nothing."""
    if not study.fit.shared.striped:
        return ""
    return (
        "An error changes from frame to frame and reaches farther over the image than a filter, as "
        "moving waves do. Where neighbouring pixels differ in it, it counts as noise."
    )


def _closed(gap: Gap) -> str:
    sentence = (
        f"The effects close {percent(gap.closed)} {interval_words(gap.closed.interval)} of the "
        "squared gap that recalibration leaves."
    )
    if gap.closed.interval[0] <= 0:
        sentence += " Whether they help at all is not certain."
    if gap.hand_eye_shift[0] > 0:
        shift = mm(gap.hand_eye_shift[0])
        sentence += f" With them the hand-eye translation changes by {shift} mm."
    return sentence


def _nothing_found(detectable: Mapping[str, float | None]) -> str:
    sizes = sorted((size, name) for name, size in detectable.items() if size is not None)
    if not sizes:
        return "No effect was found."
    return (
        "No effect was found. The smallest effects that would have been detected are between "
        f"{mm(sizes[0][0])} and {mm(sizes[-1][0])} mm ({sizes[-1][1]})."
    )


def most_biased(groups: Mapping[str, Sequence[Region]]) -> list[tuple[str, Sequence[Region]]]:
    """Return covariates and their regions: the most significant first, then the widest range."""

    def order(item: tuple[str, Sequence[Region]]) -> tuple[float, float]:
        biases = biases_of(item[1]) or [0.0]
        return min(region.p_value for region in item[1]), min(biases) - max(biases)

    return sorted(groups.items(), key=order)


def biases_of(regions: Sequence[Region]) -> list[Estimated]:
    """Return the bias of each bin of a covariate, metres."""
    return [region.bias for region in regions if not region.trend]


def axis_label(covariate: str) -> str:
    """Return what a covariate is called on an axis, with its unit after a comma."""
    return _LABELS.get(covariate, covariate)


def along(stage: Stage) -> tuple[str, str, str, bool]:
    """Return how the bias of a stage goes along the covariate where it is clearest.

    Returns:
        The covariate; from where to where its bins go, empty without a bin; by how much its trend;
        and whether that is significant.
    """
    strips = most_biased(stage.by_covariate())
    if not strips:
        return "", "", "", False
    covariate, regions = strips[0]
    biases, significant = biases_of(regions), min(one.p_value for one in regions) <= LEVEL
    bins = f"from {mm(min(biases))} to {mm(max(biases))} mm" if biases else ""
    return axis_label(covariate).split(",")[0], bins, f"by {mm(regions[0].bias)} mm", significant
