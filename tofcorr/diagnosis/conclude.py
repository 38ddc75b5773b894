"""All findings about a recording, from its sums."""

from collections.abc import Callable

import torch

from tofcorr.diagnosis.findings.effect_comparison import least_p_value
from tofcorr.diagnosis.findings.gap import (
    gap_steps,
    judge_remainder,
    measure_gap,
    name_in_two,
    resampled,
    stages_of,
)
from tofcorr.diagnosis.findings.shares import attribute, explained_squares, parts_of
from tofcorr.diagnosis.given.simulator import GivenSimulator
from tofcorr.diagnosis.next.advice import minimum_detectable, next_recording
from tofcorr.diagnosis.prepare import Prepared
from tofcorr.diagnosis.report.result import DiagnosisResult, Evidence
from tofcorr.diagnosis.report.words import list_causes, list_remarks, write_verdict
from tofcorr.diagnosis.rerun.checks import check_in_simulator, measure_transfer, observables_of
from tofcorr.diagnosis.rerun.sensor import degraded_stage, fitted_values
from tofcorr.diagnosis.rerun.simulator import simulator_of, tables_of, whole_patterns


def conclude(
    prepared: Prepared, simulator: GivenSimulator | None, begin: Callable[[str], object]
) -> DiagnosisResult:
    """Return all findings; their verdict is that of the gap, without doubts about the recording.

    Args:
        prepared: The recording, before any effect was named.
        simulator: The simulator under diagnosis; None: one is fitted to the recording.
        begin: Called with the name of each stage.
    """
    study, residual = prepared.study, prepared.as_given
    options, recording = study.options, study.observations.recording
    given = None if simulator is None else simulator.options
    rendered = simulator is not None and given is None
    begin("naming effects")
    generator = torch.Generator().manual_seed(options.seed + 1)
    resamples = resampled(study.sums.num_units, options.bootstraps, generator)
    named = name_in_two(study, resamples)

    begin("measuring the gap")
    parts, explained = parts_of(study, named, residual), None
    if residual is not None:
        once = torch.ones_like(resamples[:1])
        explained = explained_squares(parts, torch.cat([once, resamples]))
    gap = measure_gap(study, named, resamples, explained)
    shares = attribute(parts, gap, resamples)
    begin("judging what remains")
    stages = stages_of(study, named, gap, residual)
    remainder = judge_remainder(study, named, gap, stages[-1])
    detectable = minimum_detectable(study, named, options.seed + 2)

    patterns = whole_patterns(study, named, given)
    with_effects = None if rendered else simulator_of(study, named, given)
    beyond = [] if rendered else tables_of(study, named, given)[1]
    warnings = list(prepared.warnings)
    if beyond:
        warnings.append(
            "simulator_with_effects.yaml lacks these terms of the base model: "
            f"{', '.join(term.options.kind for term, _ in beyond)}. The simulator has no table for "
            "them; the findings include them."
        )
    closure = transfer = degraded = None
    if options.simulate_anew:
        transfer = measure_transfer(study, named, given, generator, resamples)
        degraded = degraded_stage(study, named, with_effects, gap.floor, resamples)
        closure = check_in_simulator(study, named, given)
    frames = None
    if simulator is not None:
        frames = simulator.options or simulator.rendered_frames(recording)
    level = options.tests.level
    observables = observables_of(recording, frames, seed=options.seed + 3, level=level)
    if patterns and with_effects is not None:
        with_effects = simulator_of(study, named, given, patterns)

    given_effects = () if given is None else given.effects
    return DiagnosisResult(
        verdict=write_verdict(named, gap, remainder, shares),
        causes=list_causes(study, named, shares),
        remarks=list_remarks(study, named, gap, remainder, detectable),
        simulator_kind="fitted" if simulator is None else simulator.kind,
        stages=stages,
        shares=shares,
        warnings=tuple(warnings),
        detected=named.tested and (bool(named.names) or remainder.unknown),
        p_value=least_p_value(study, named.first),
        effects=named.names,
        cause_sets=named.cause_sets,
        likeliest=named.likeliest,
        refined_terms=named.refined_terms,
        tested=named.tested,
        gap=gap,
        gap_steps=tuple(gap_steps(study, named, gap, resamples)),
        remainder=remainder,
        outliers=prepared.outliers,
        ranking=tuple(named.first.ordered()),
        missing=dict(study.candidates.missing),
        detectable=detectable,
        advice=tuple(next_recording(study, named)),
        closure=closure,
        transfer=transfer,
        fitted=fitted_values(study, named, given_effects, resamples),
        degraded=degraded,
        observables=observables,
        simulator=with_effects,
        options=options,
        evidence=Evidence(study=study, named=named, patterns=patterns),
    )
