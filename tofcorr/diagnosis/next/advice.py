"""What to record next, so that more can be concluded."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from tofcorr.diagnosis.findings.absorption import absorbed_share, remainder
from tofcorr.diagnosis.findings.effect_comparison import EffectTest
from tofcorr.diagnosis.findings.naming import NamedEffects
from tofcorr.diagnosis.next.candidates import Candidates, make_candidates
from tofcorr.diagnosis.next.detectable import noncentrality
from tofcorr.diagnosis.sums.linear_system import Sums
from tofcorr.diagnosis.sums.study import Study
from tofcorr.simulation.effects import CATALOGUE

# Frames that are advised for one question, and questions that are answered. Chosen: what a person
# records in one go.
_FRAMES_ADVISED = 8
_MOST_QUESTIONS = 3
# An effect of which calibration absorbs more than this share needs another recording. Chosen.
_MOSTLY_ABSORBED = 0.97
# A detectable size beyond this, metres, is not reported. Chosen: it is no error of a depth camera.
_LARGEST_SIZE = 1.0


@dataclass(frozen=True, kw_only=True)
class Question:
    """What a recording should decide: whether the cause is one effect or another.

    Attributes:
        effect: The effect to identify.
        others: The effects to distinguish it from, besides the calibration.
    """

    effect: str
    others: tuple[str, ...]


def next_recording(study: Study, named: NamedEffects) -> list[str]:
    """Return what to record next, the most useful first, in sentences.

    First which frames would distinguish the effects of a cause set, or show an effect that the
    calibration absorbs; then the inputs of effects that could not be tested.
    """
    asked = _questions(study, named)
    advice: list[str] = []
    if asked:
        wanted = {name for question in asked for name in (question.effect, *question.others)}
        candidates = make_candidates(study, wanted)
        if candidates is None:
            advice += [f"{_goal(one)}: {CATALOGUE[one.effect].remedy}." for one in asked]
        else:
            advice += [
                _advised(study, named, candidates, candidates.sums.gls, question)
                for question in asked
            ]
    advice += [
        f"{name} could not be tested: it needs {', '.join(wants)}. Best: {CATALOGUE[name].remedy}."
        for name, wants in study.candidates.missing.items()
    ]
    return advice


def _questions(study: Study, named: NamedEffects) -> list[Question]:
    """Return the cause sets to be separated, then the effects that calibration absorbs."""
    asked = []
    for members in named.cause_sets:
        known = [name for name in members if name in study.candidates.effects]
        if len(known) > 1 and len(known) == len(members):
            asked.append(Question(effect=known[0], others=tuple(known[1:])))
    hidden = [
        name
        for name in study.candidates.effects
        if absorbed_share(study, name) > _MOSTLY_ABSORBED and name not in named.names
    ]
    asked += [Question(effect=name, others=()) for name in hidden]
    return asked[:_MOST_QUESTIONS]


def _advised(
    study: Study, named: NamedEffects, candidates: Candidates, sums: Sums, question: Question
) -> str:
    """Choose the most informative frames for one question, one after another; describe them."""
    names = [*question.others, question.effect]
    members = study.sums.layout.of(question.others)
    prior = study.sums.layout.prior_of(members)
    own = study.sums.layout.of(names)
    total, frames = study.sums.gls.total[own][:, own], sums.of(names)[0]
    size = len(total) - len(members)

    def information(gram: Tensor) -> Tensor:
        """Return the information on the effect, per coefficient, given calibration and others."""
        left = remainder(gram, len(members), prior)
        return left.diagonal(dim1=-2, dim2=-1).sum(-1) / size

    before = float(information(total))
    picked: list[int] = []
    for _ in range(_FRAMES_ADVISED):
        gains = information(total + frames)
        gains[picked] = -torch.inf
        picked.append(int(gains.argmax()))
        total = total + frames[picked[-1]]
    after = float(information(total))
    test = named.first.tests[question.effect]
    now = _detectable_size(study, test, named.first.critical_score(0.05), before)
    ratio = float(np.sqrt(max(before, 1e-30) / max(after, 1e-30)))
    return (
        f"{_goal(question)}, record {_FRAMES_ADVISED} more frames: {_listed(candidates, picked)}. "
        f"{_gain(now, now * ratio)} In general: {CATALOGUE[question.effect].remedy}."
    )


def _goal(question: Question) -> str:
    if question.others:
        return f"To distinguish {question.effect} from {' and '.join(question.others)}"
    return f"To observe {question.effect}, which calibration absorbs"


def _gain(now: float, then: float) -> str:
    """Describe the size that would be detected, before and after, metres."""
    if not np.isfinite(now):
        return "It could then be detected."
    return f"It could then be detected from {_mm(then)} mm on, instead of {_mm(now)} mm."


def _listed(candidates: Candidates, picked: Sequence[int]) -> str:
    counted = Counter(candidates.words[number] for number in picked)
    parts = []
    for words, count in counted.most_common():
        sources = {candidates.source[n] for n in picked if candidates.words[n] == words}
        numbers = ", ".join(str(number) for number in sorted(sources))
        parts.append(f"{count} {words} (like frame{'s' if len(sources) > 1 else ''} {numbers})")
    return "; ".join(parts)


def _detectable_size(study: Study, test: EffectTest, critical: float, information: float) -> float:
    """Return the root mean square that would be detected with this information, metres."""
    ols = study.sums.ols
    low, high = ols.layout.effects[test.name]
    scale = ols.scale * study.sums.count.sum()
    raw = float((ols.total[low:high, low:high] / scale).trace()) / (high - low)
    if information <= 0:
        return float("inf")
    size = np.sqrt(raw * noncentrality(test, critical) / information)
    return float(size) if size < _LARGEST_SIZE else float("inf")


def _mm(metres: float) -> str:
    return f"{metres * 1e3:.1f}"
