"""What follows from the effects that were named: sizes, places, what remains, what to do next."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from tofcorr.diagnosis.findings.gap import Gap, Interval, gap_steps, measure_gap
from tofcorr.diagnosis.findings.naming import NamedEffects
from tofcorr.diagnosis.findings.open_set import OpenSet, judge_remainder
from tofcorr.diagnosis.findings.shares import Share, attribute, explained_squares, parts_of
from tofcorr.diagnosis.findings.where import Stage, stages_of
from tofcorr.diagnosis.given.simulator import GivenSimulator
from tofcorr.diagnosis.next.advice import next_recording
from tofcorr.diagnosis.next.detectable import minimum_detectable
from tofcorr.diagnosis.prepare import Prepared
from tofcorr.diagnosis.rerun.fitted_values import FittedValue, fitted_values


@dataclass(frozen=True, kw_only=True)
class Judged:
    """What follows from the effects that were named; each as in `DiagnosisResult`."""

    gap: Gap
    gap_steps: tuple[tuple[str, float, Interval], ...]
    shares: tuple[Share, ...]
    stages: tuple[Stage, Stage, Stage]
    remainder: OpenSet
    detectable: Mapping[str, float | None]
    advice: tuple[str, ...]
    fitted: tuple[FittedValue, ...]


def judge(
    prepared: Prepared,
    named: NamedEffects,
    simulator: GivenSimulator | None,
    resamples: Tensor,
    begin: Callable[[str], object],
) -> Judged:
    """Measure the gap, share it out, and judge what remains.

    Args:
        prepared: The recording, before any effect was named.
        named: The effects named.
        simulator: The simulator under diagnosis; None: one is fitted to the recording.
        resamples: How often each resample holds each pose, shape (B, U).
        begin: Called with the name of each stage.
    """
    study, residual = prepared.study, prepared.as_given
    given = None if simulator is None else simulator.options
    begin("measuring the gap")
    parts = parts_of(study, named, residual)
    explained = None
    if residual is not None:
        once = torch.ones_like(resamples[:1])
        explained = explained_squares(parts, once)[0], explained_squares(parts, resamples)
    gap = measure_gap(study, named, resamples, explained)
    shares = attribute(parts, gap, resamples)
    begin("judging what remains")
    stages = stages_of(study, named, gap, residual)
    return Judged(
        gap=gap,
        gap_steps=tuple(gap_steps(study, named, gap, resamples)),
        shares=shares,
        stages=stages,
        remainder=judge_remainder(study, named, gap, stages[-1].found_where),
        detectable=minimum_detectable(study, named, study.options.seed + 2),
        advice=tuple(next_recording(study, named)),
        fitted=tuple(
            fitted_values(study, named, () if given is None else given.effects, resamples)
        ),
    )
