"""The list of causes below the verdict, and what else must be said."""

import math
from collections.abc import Mapping, Sequence

from tofcorr.diagnosis.findings.absorption import absorbed_share
from tofcorr.diagnosis.findings.cause_sets import CauseSet
from tofcorr.diagnosis.findings.gap import Gap, LonePoses
from tofcorr.diagnosis.findings.naming import NamedEffects
from tofcorr.diagnosis.findings.open_set import OpenSet
from tofcorr.diagnosis.findings.shares import HAND_EYE, Share
from tofcorr.diagnosis.report.verdict import mm
from tofcorr.diagnosis.report.words import (
    cause_words,
    effect_words,
    interval_words,
    percent,
    share_words,
)
from tofcorr.diagnosis.rerun.fitted_simulator import solution_of
from tofcorr.diagnosis.sums.study import Study
from tofcorr.geometry import se3
from tofcorr.simulation.effects import CATALOGUE

# Above this share a line says how much of an effect the calibration absorbs. Chosen.
_WORTH_SAYING = 0.2
# From this share on a line says what another member of a cause set closes. Chosen: what effects
# close on held-out poses scatters, and may come out below zero.
_WORTH_A_SHARE = 0.05
# Above this share a line says how much of it a constant is. Chosen.
_WORTH_A_CONSTANT = 0.05
# Above this share of a gap that is the same in every image a line says how to correct it. Chosen.
_MOST = 0.5
_STATIC = "is the same in every image"


def list_causes(study: Study, named: NamedEffects, shares: Sequence[Share]) -> tuple[str, ...]:
    """Return a line for each cause, the largest share first."""
    # A parameter that was left as the simulator has it causes nothing.
    causes = (one for one in shares if one.kind == "effect" or one.share or any(one.interval))
    known = sorted((one for one in causes if one.kind != "unexplained"), key=lambda s: -s.share)
    return tuple(_line(study, named, one) for one in known)


def _line(study: Study, named: NamedEffects, one: Share) -> str:
    words, share = cause_words(study, one), share_words(one.share)
    line = f"{words}: {share} {interval_words(one.interval)} of the squared gap"
    if one.of_constant is not None and one.of_constant > _WORTH_A_CONSTANT:
        line += f" ({percent(one.of_constant)} by a constant offset, which any cause may have)"
    if one.kind == "effect":
        return f"{line}; {_effect(named, one.cause)}."
    if one.cause == HAND_EYE and study.fit.known is not None:
        moved = se3.log(
            se3.inverse(study.fit.known.tool_from_camera) @ solution_of(study, named)[0]
        )
        turn = math.degrees(float(moved[3:].norm()))
        return (
            f"{line}; the camera sits {mm(float(moved[:3].norm()))} mm and {turn:.2f} degrees from "
            "where the simulator has it."
        )
    return f"{line}; a parameter of the simulator's error model."


def _effect(named: NamedEffects, name: str) -> str:
    effect = CATALOGUE[name]
    words = effect.summary
    if not named.study.fit.model.groups.isdisjoint(effect.refines):
        words = f"the base model's {name} term, and a higher-order form of it"
    own = named.sets[named.names.index(name)]
    others = [member for member in own.members if member != name]
    rivals = [_other(named, own, member) for member in others if member not in named.names]
    if rivals:
        words += f", which these data cannot distinguish from {', '.join(rivals)}"
    causes = [effect_words(named.study, member) for member in others if member in named.names]
    if causes:
        words += f"; it may be an error in the form of {' or '.join(causes)}"
    if name in named.study.candidates.effects:
        absorbed = absorbed_share(named.study, name)
        if absorbed > _WORTH_SAYING:
            words += f"; calibration absorbs about {percent(absorbed)} of such an effect"
    return words


def _other(named: NamedEffects, own: CauseSet, member: str) -> str:
    """Return another member of a cause set, with what it closes in the place of the named one."""
    words = effect_words(named.study, member)
    share = own.closes.get(member, 0.0)
    if share < _WORTH_A_SHARE:
        return words
    return f"{words} (closes {percent(share)} of what this one closes)"


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
    remarks = [_alone(alone), _largest_component(gap, named)]
    if not named.tested:
        poses = named.study.system.blocks.num_units
        remarks.append(
            f"With {poses} poses effects are ranked but not tested; a test needs "
            f"{named.study.options.tests.least_images}."
        )
    if named.names:
        remarks.append(_closed(gap))
    elif named.tested and not remainder.unknown:
        remarks.append(_nothing_found(detectable))
    if named.refined_terms:
        remarks.append(_refined(named.refined_terms))
    remarks.append(_scatter(named, remainder))
    remarks.append(_moving_waves(named.study))
    if remainder.unknown and remainder.fingerprint:
        first, *more = remainder.fingerprint
        remarks.append(
            " ".join([f"The gap that remains {first}.", *(f"It {clause}." for clause in more)])
        )
    if missing:
        remarks.append(f"Not tested (missing data): {', '.join(missing)}.")
    return tuple(remark for remark in remarks if remark)


def _alone(poses: LonePoses | None) -> str:
    """Say that the gap is large because the recording says too little."""
    if poses is None:
        return ""
    frames, (near, far) = poses.frames, poses.distance
    one = len(frames) == 1
    first = (
        f"Frame {frames[0]}" if one else f"{len(frames)} poses, such as that of frame {frames[0]}"
    )
    return (
        f"{first}, at {near:.1f} to {far:.1f} m, {'makes' if one else 'make'} "
        f"{percent(poses.share)} of the squared gap: the gap is what a fit to all other poses "
        f"misses, and no other pose is like {'this one' if one else 'these'}. The others make "
        f"{mm(poses.others)} mm. Record more poses there."
    )


def _largest_component(gap: Gap, named: NamedEffects) -> str:
    total = gap.before**2
    # What noise may be all of, or is printed as 0.0 mm, is not shared out.
    if float(mm(gap.before_interval[0])) == 0:
        return ""
    parts = [
        (gap.between_images**2 / total, "shifts or tilts whole images"),
        (gap.fixed_pattern**2 / total, _STATIC),
        (
            gap.within_images**2 / total,
            "varies within images, from image to image, or between the frames of a pose",
        ),
    ]
    share, words = max(parts)
    sentence = f"After recalibration {percent(share)} of the squared gap {words}"
    # Its cause need not be known to be corrected.
    if words == _STATIC and not named.maps and share > _MOST:
        sentence += ": whatever its cause, a table of one offset for each pixel corrects it"
    return f"{sentence}."


def _scatter(named: NamedEffects, remainder: OpenSet) -> str:
    """Say how far poses scatter, where that is more than half of a gap that matters."""
    least = named.study.options.target_gap_mm * 1e-3 / 2
    if not named.tested or remainder.unknown or remainder.scatter < least:
        return ""
    return (
        f"The poses of camera or target scatter by {mm(remainder.scatter)} mm, which depends on "
        "nothing recorded: a robot or a survey of that repeatability explains it."
    )


def _moving_waves(study: Study) -> str:
    """Say that waves which change from frame to frame count as noise in part."""
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
        sentence += (
            f" With them the hand-eye translation changes by {mm(gap.hand_eye_shift[0])} mm."
        )
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
        f"{mm(min(known.values()))} and {mm(known[weakest])} mm ({weakest})."
    )
