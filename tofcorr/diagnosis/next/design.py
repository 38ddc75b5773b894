"""What these data could have shown, and what to record next."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from tofcorr.diagnosis.findings.select import Selection
from tofcorr.diagnosis.findings.which import EffectTest, absorbed_share
from tofcorr.diagnosis.next.candidates import Candidates, make_candidates
from tofcorr.diagnosis.sums.blocks import likely_sums
from tofcorr.diagnosis.sums.study import BASE_FORMS, Study
from tofcorr.simulation.effects import CATALOGUE

# The normal quantile of 80 % power.
_POWER_QUANTILE = 0.8416
_DRAWS = 64
# Of a signal that base model and hand-eye take up to this share nothing can be said.
_ALL = 0.999
# Frames that are advised for one question, and questions that are answered.
_FRAMES_ADVISED = 8
_MOST_QUESTIONS = 3
# An effect of which calibration takes up this share is worth recording for.
_MOSTLY = 0.97


@dataclass(frozen=True, kw_only=True)
class Question:
    """What a recording should decide: one effect apart from calibration and from others."""

    effect: str
    others: tuple[str, ...]


def minimum_detectable(study: Study, selection: Selection, seed: int) -> dict[str, float | None]:
    """Return for every effect the size that would be found with 80 % probability, metres.

    The size is the root mean square of the effect's own signal over all pixels, before base model
    and hand-eye take up their part. None: base model and hand-eye take up all of it.
    """
    generator = torch.Generator().manual_seed(seed)
    critical = _critical_score(selection)
    sizes: dict[str, float | None] = {}
    for name, test in selection.first.tests.items():
        if name in study.effects:
            sizes[name] = _of_columns(study, test, critical, generator)
        else:
            sizes[name] = _of_map(study, test, critical)
    return sizes


def next_recording(study: Study, selection: Selection) -> list[str]:
    """Return what to record so that more can be told, the most useful first."""
    asked = _questions(study, selection)
    advice: list[str] = []
    if asked:
        wanted = {name for question in asked for name in (question.effect, *question.others)}
        candidates = make_candidates(study, wanted)
        advice += [_advised(study, selection, candidates, question) for question in asked]
    advice += [
        f"{name} could not be judged; record {', '.join(wants)}: {CATALOGUE[name].remedy}."
        for name, wants in study.missing.items()
    ]
    return advice


def _questions(study: Study, selection: Selection) -> list[Question]:
    """Return the sets to be separated, then the effects that calibration takes up."""
    asked = []
    for members in selection.sets:
        known = [name for name in members if name in study.effects]
        if len(known) > 1 and len(known) == len(members):
            asked.append(Question(effect=known[0], others=tuple(known[1:])))
    hidden = [
        name
        for name in study.effects
        if absorbed_share(study, name) > _MOSTLY and name not in selection.named
    ]
    asked += [Question(effect=name, others=()) for name in hidden]
    return asked[:_MOST_QUESTIONS]


def _advised(study: Study, selection: Selection, candidates: Candidates, question: Question) -> str:
    """Choose the frames that tell most about one question, one after another; say them in words."""
    sums = likely_sums(candidates.moments, study.blocks.pose_sd, study.blocks.dispersion)
    total = study.blocks.likely.gram.sum(0)
    before = _separated(study, total, question)
    picked: list[int] = []
    for _ in range(_FRAMES_ADVISED):
        gains = [
            _separated(study, total + sums.gram[number], question)
            if number not in picked
            else -np.inf
            for number in range(len(candidates.words))
        ]
        best = int(np.argmax(gains))
        picked.append(best)
        total = total + sums.gram[best]
    after = _separated(study, total, question)
    counted = Counter(candidates.words[number] for number in picked)
    frames = "; ".join(
        f"{count} {words} (as frame{'s' if count > 1 else ''} {_frames(candidates, picked, words)})"
        for words, count in counted.most_common()
    )
    test = selection.first.tests[question.effect]
    ratio = float(np.sqrt(max(before, 1e-30) / max(after, 1e-30)))
    now = _size_for(study, test, _critical_score(selection), before)
    goal = f"To tell {question.effect} from {' and '.join(question.others)}"
    if not question.others:
        goal = f"To see {question.effect}, which calibration takes up"
    size = (
        f" It would then show from {_mm(now * ratio)} mm instead of {_mm(now)} mm"
        if np.isfinite(now)
        else " It would then show"
    )
    return f"{goal}, record {_FRAMES_ADVISED} more frames: {frames}.{size}. {_remedy(question)}"


def _frames(candidates: Candidates, picked: Sequence[int], words: str) -> str:
    numbers = {candidates.source[n] for n in picked if candidates.words[n] == words}
    return ", ".join(str(number) for number in sorted(numbers))


def _remedy(question: Question) -> str:
    return f"In general: {CATALOGUE[question.effect].remedy}."


def _separated(study: Study, gram: Tensor, question: Question) -> float:
    """Return the information on an effect that calibration and the others leave, per direction."""
    layout = study.blocks.layout
    low, high = layout.effects[question.effect]
    members = layout.of(question.others)
    left = _left_over(gram, members, low, high, layout.prior[members])
    return float(left.trace()) / (high - low)


def _size_for(study: Study, test: EffectTest, critical: float, information: float) -> float:
    """Return the root mean square that is told apart with this information, metres."""
    even = study.blocks.even
    low, high = even.layout.effects[test.name]
    scale = study.blocks.even_scale * study.blocks.count.sum()
    raw = float((even.gram.sum(0)[low:high, low:high] / scale).trace()) / (high - low)
    if information <= 0:
        return float("inf")
    size = np.sqrt(raw * _needed(test, critical) / information)
    return float(size) if size < 1.0 else float("inf")


def _critical_score(selection: Selection) -> float:
    """Return the score that the best effect must reach, from the flips of all effects."""
    best = torch.stack([t.null_scores() for t in selection.first.tests.values()]).amax(0)
    return float(torch.quantile(best, 0.95))


def _needed(test: EffectTest, critical: float) -> float:
    """Return the noncentrality that brings the gain over its critical value in 80 % of cases."""
    middle, high = torch.quantile(test.null, test.null.new_tensor([0.5, 0.95])).tolist()
    threshold = middle + critical * (high - middle) / 1.6449
    level = max(threshold - middle, 1.0)
    return (_POWER_QUANTILE + float(np.sqrt(_POWER_QUANTILE**2 + level))) ** 2


def _of_columns(
    study: Study, test: EffectTest, critical: float, generator: torch.Generator
) -> float | None:
    likely, even = study.blocks.likely, study.blocks.even
    if absorbed_share(study, test.name) > _ALL:
        return None
    low, high = even.layout.effects[test.name]
    members = torch.arange(even.layout.base)
    seen = _left_over(likely.gram.sum(0), members, low, high, even.layout.prior[members])
    plain = even.gram.sum(0) / (study.blocks.even_scale * study.blocks.count.sum())
    raw = plain[low:high, low:high]
    left = _left_over(plain, members, low, high, 1e-12 * torch.ones(len(members)).double())
    directions = torch.randn(_DRAWS, high - low, generator=generator, dtype=torch.float64)
    signal = _quadratic(directions, seen).clamp(min=1e-30)
    size = _quadratic(directions, raw)
    remains = _quadratic(directions, left).clamp(min=1e-30)
    detectable = (size / signal * _needed(test, critical)).sqrt()
    tests = study.options.tests
    material = tests.form_tolerance_mm if test.name in BASE_FORMS else tests.material_mm
    nameable = (size / remains).sqrt() * material * 1e-3
    return float(torch.maximum(detectable, nameable).median())


def _left_over(gram: Tensor, members: Tensor, low: int, high: int, prior: Tensor) -> Tensor:
    """Return the Gram matrix of an effect after the base model took its part."""
    inner = gram[members][:, members] + torch.diag(prior)
    cross = gram[members, low:high]
    return gram[low:high, low:high] - cross.T @ torch.linalg.solve(inner, cross)


def _quadratic(directions: Tensor, matrix: Tensor) -> Tensor:
    return torch.einsum("di,ij,dj->d", directions, matrix, directions)


def _of_map(study: Study, test: EffectTest, critical: float) -> float:
    """A map of independent values: each cell is as precise as its pixels together."""
    precision = float(study.weight.sum())
    middle, high = torch.quantile(test.null, test.null.new_tensor([0.5, 0.95])).tolist()
    threshold = critical * (high - middle) / 1.6449 + (high - middle)
    detectable = np.sqrt(max(threshold, 1.0) / precision)
    return float(max(detectable, study.options.tests.material_mm * 1e-3))


def _mm(metres: float) -> str:
    return f"{metres * 1e3:.1f}"
