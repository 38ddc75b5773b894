"""The text beside each picture of the page: what to see, and what a reader without eyes hears."""

from collections.abc import Callable, Sequence

import numpy as np

from tofcorr.diagnosis.findings.where import Region
from tofcorr.diagnosis.report import beside_captions
from tofcorr.diagnosis.report.caption import Caption
from tofcorr.diagnosis.report.residual_figures import most_biased, name_of
from tofcorr.diagnosis.report.result import DiagnosisResult
from tofcorr.diagnosis.report.stage_figures import STAGE_WORDS
from tofcorr.diagnosis.report.verdict import mm, sized
from tofcorr.diagnosis.report.words import (
    LEAST_SHARE,
    MOST_SHARE,
    cause_words,
    effect_words,
    percent,
    share_words,
)

# Share of the gap as given below which the text says what of the recalibrated gap an effect closes
# (no unit). Chosen: so small a share looks as if the effect did not matter.
_SMALL = 0.05
# Adjusted p-value below which a text speaks of a bias. 5 % by convention.
_SIGNIFICANT = 0.05


def caption_of(name: str, result: DiagnosisResult) -> Caption:
    """Return the words of a figure of `DiagnosisResult.all_figures`, by its name."""
    return CAPTIONS[name](result)


def _stages(result: DiagnosisResult) -> Caption:
    sizes = [
        f"{STAGE_WORDS[one.name]} {sized(one.gap, one.interval)}"
        for one in result.stages_known
        if one.gap is not None and one.interval is not None
    ]
    finding = f"The simulator differs from the recording by: {', '.join(sizes)}."
    if result.stages[0].gap is None:
        finding = f"No simulator was given; one was fitted. It differs by: {', '.join(sizes)}."
    degraded = result.degraded
    if degraded is not None:
        finding += f" Ideal frames, degraded: {sized(degraded.gap, degraded.interval)}."
    return Caption(
        finding=finding,
        reading="A bar is the root mean square difference on poses that the fit has not used, with "
        "the noise subtracted (in squares). Black lines are 95 % intervals; poses are drawn anew "
        "for them. A bar with + adds one effect to those above it. Recalibrated: "
        f"{_refitted(result)} refitted to the recording." + _of_degraded(result),
        alt=f"Bars of the gap at each stage: {', '.join(sizes)}.",
    )


def _refitted(result: DiagnosisResult) -> str:
    free = result.evidence.study.fit.model.hand_eye_free
    return "hand-eye transform and base terms" if free else "base terms"


def _of_degraded(result: DiagnosisResult) -> str:
    """Return how the bar of degraded frames came about."""
    if result.degraded is None:
        return ""
    without = [sentence.split(":")[0] for sentence in result.degraded.left_out]
    sentence = (
        f" Degraded frames: ideal depth at {result.degraded.poses} poses, through a sensor.yaml "
        "fitted to other poses. That is what remains for whoever trains on degraded frames."
    )
    if without:
        sentence += f" They lack what no depth image can show: {', '.join(without)}."
    return sentence


def _attribution(result: DiagnosisResult) -> Caption:
    known = [one for one in result.shares if one.kind != "unexplained"]
    study = result.evidence.study
    shares = ", ".join(
        f"{cause_words(study, one)} {share_words(one.share)}" for one in result.shares
    )
    if any(one.share for one in known):
        largest = max(known, key=lambda one: one.share)
        finding = f"The largest cause is {cause_words(study, largest)} with "
        finding += f"{share_words(largest.share)}."
    else:
        finding = "No cause was found."
    if any(one.share < -0.005 for one in known):
        finding += " A cause with a negative share cancels part of another."
    closing = {entry.name: entry.closed_fraction for entry in result.ranking}
    effects = [one for one in known if one.kind == "effect" and one.cause in closing]
    small = any(abs(one.share) < _SMALL for one in effects)
    if small and result.stages[0].gap is not None:
        each = [f"{effect_words(study, e.cause)} {share_words(closing[e.cause])}" for e in effects]
        finding += (
            " Effects are named for what recalibration leaves; of the square of that gap they "
            f"close, each alone: {', '.join(each)}."
        )
    ends = [end for one in result.shares for end in one.interval]
    cut = min(ends) < LEAST_SHARE or max(ends) > MOST_SHARE
    where = f", cut off at {percent(LEAST_SHARE)} and {percent(MOST_SHARE)}" if cut else ""
    return Caption(
        finding=finding,
        reading="Shares of the squared gap; they sum to 100 %. Grey: parameters of the simulator. "
        f"Red: effects. Light: unexplained. Black lines are 95 % intervals{where}.",
        alt=f"Bars of the share of each cause: {shares}.",
    )


def _where_as_given(result: DiagnosisResult) -> Caption:
    where = result.stages[0].found_where
    finding = f"As given, the mean residual is {mm(float(where.offsets.mean()))} mm."
    covariate, regions = most_biased(where.by_covariate())[0]
    ends = _ends(regions)
    if ends:
        finding += f" Along {name_of(covariate)} it goes {ends}."
    return Caption(
        finding=finding,
        reading="Mean residual along the four covariates with the most significant bias; the band "
        "is a 95 % band for all bins of all covariates together.",
        alt="Curves of the bias of the simulator as given along covariates.",
    )


def _where(result: DiagnosisResult) -> Caption:
    finding = "After recalibration, the bias depends on no covariate at the 5 % level."
    strips = most_biased(result.where.by_covariate())
    if strips and min(region.p_value for region in strips[0][1]) <= _SIGNIFICANT:
        covariate, regions = strips[0]
        ends = _ends(regions) or f"by {mm(regions[0].bias)} mm"
        finding = f"After recalibration, the bias is clearest along {name_of(covariate)}: "
        finding += f"it goes {ends}."
    return Caption(
        finding=finding,
        reading="Red: recalibrated, with a 95 % band for all bins of all covariates together. "
        "Blue: with the effects. p is the probability of such a bias anywhere if there is none.",
        alt="Curves of the bias along covariates, recalibrated and with the effects.",
    )


def _ends(regions: Sequence[Region]) -> str:
    """Return the least and the largest bias of a covariate's bins as text; empty without a bin."""
    biases = [region.bias for region in regions if not region.trend]
    return f"from {mm(min(biases))} to {mm(max(biases))} mm" if biases else ""


def _map(result: DiagnosisResult) -> Caption:
    found = [
        f"{STAGE_WORDS[one.name]} {int((one.found_where.tile_p_values <= _SIGNIFICANT).sum())}"
        for one in result.stages_known
    ]
    tiles = int(np.isfinite(result.where.tiles).sum())
    return Caption(
        finding=f"Tiles that differ from zero, of {tiles} with data: {', '.join(found)}.",
        reading="Mean residual over the image, red where the camera reads too far. A dot marks a "
        "tile that differs from zero (5 % level). Each picture has a colour scale of its own.",
        alt=f"Maps of the mean residual over the image at {len(found)} stages.",
    )


def _series(result: DiagnosisResult) -> Caption:
    spread = [
        f"{STAGE_WORDS[one.name]} {mm(float(one.found_where.offsets.std()))} mm"
        for one in result.stages_fitted
    ]
    return Caption(
        finding=f"Standard deviation of the poses' means: {', '.join(spread)}.",
        reading="Mean residual of each pose. A trend points to time or temperature. Single poses "
        "that stand out point to the robot or the target.",
        alt="Curves of the mean residual of each pose in the order of the recording.",
    )


def _which(result: DiagnosisResult) -> Caption:
    named = ", ".join(effect_words(result.evidence.study, name) for name in result.effects)
    level = percent(1 - result.options.tests.level)
    return Caption(
        finding=f"Named: {named}." if named else "No effect is named.",
        reading="Each effect is added alone, all parameters are refitted, and whole poses are held "
        "out. Left: the squared gap that it closes on them, with 95 % intervals. Right: its "
        "score, the gain in likelihood. If nothing is missing, the best score of all lies in the "
        f"grey band in {level} of recordings. Higher order: beyond the base term of that name. "
        "Red: named. Blue: indistinguishable from a named effect.",
        alt=f"Dots of what each effect closes, and of its score. Named: {named or 'none'}.",
    )


def _aliases(result: DiagnosisResult) -> Caption:
    study = result.evidence.study
    sets = [[effect_words(study, name) for name in members] for members in result.cause_sets]
    groups = [members for members in sets if len(members) > 1]
    finding = "Effects named here can be distinguished from all others."
    more = ""
    if groups:
        more = " An effect that closes not significantly less than one named is also called so."
        finding = "These data cannot distinguish " + "; ".join(
            f"{members[0]} from {', '.join(members[1:])}" for members in groups
        )
        finding += "."
    elif not result.effects:
        finding = "What these poses cannot show, whatever the camera does."
    return Caption(
        finding=finding,
        reading="First column: the share of the row's effect that calibration absorbs. Further "
        "columns: the share of the rest that the column's effect absorbs; black: the two cannot "
        "be distinguished. Tinted: nothing is left, or row and column are the same effect." + more,
        alt="Map of the share of each effect that calibration and other effects absorb.",
    )


def _poses(result: DiagnosisResult) -> Caption:
    before, after = result.evidence.pose_errors
    better = int((after < before).sum())
    finding = f"The effects bring {better} of {len(before)} held-out poses nearer."
    if not result.effects:
        finding = "No effect is named, so all poses lie on the line."
    return Caption(
        finding=finding,
        reading="Every dot is a held-out pose. Below the line the effects help. Dotted: noise of "
        "one pixel.",
        alt="Dots of the error of each pose before and after the effects.",
    )


CAPTIONS: dict[str, Callable[[DiagnosisResult], Caption]] = {
    "stages": _stages,
    "attribution": _attribution,
    "where_as_given": _where_as_given,
    "where": _where,
    "map": _map,
    "series": _series,
    "which": _which,
    "aliases": _aliases,
    "poses": _poses,
    "noise": beside_captions.noise,
    "dropouts": beside_captions.dropouts,
    "amplitude": beside_captions.amplitude,
}
"""The words of each figure, by its name; a new figure takes its line here."""
