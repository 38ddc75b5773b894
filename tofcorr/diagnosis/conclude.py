"""All findings about a recording, from its sums."""

from collections.abc import Callable

import torch

from tofcorr.diagnosis.findings.absorption import rank_effects
from tofcorr.diagnosis.findings.effect_comparison import least_p_value
from tofcorr.diagnosis.findings.gap import draw_resamples, lone_poses
from tofcorr.diagnosis.findings.naming import NamedEffects
from tofcorr.diagnosis.findings.open_set import name_in_two
from tofcorr.diagnosis.given.simulator import GivenSimulator
from tofcorr.diagnosis.judge import judge
from tofcorr.diagnosis.prepare import Prepared
from tofcorr.diagnosis.report.evidence import Evidence
from tofcorr.diagnosis.report.remarks import list_causes, list_remarks
from tofcorr.diagnosis.report.result import DiagnosisResult
from tofcorr.diagnosis.report.verdict import write_verdict
from tofcorr.diagnosis.rerun.anew import Anew, pieces_of_anew
from tofcorr.diagnosis.rerun.fitted_simulator import simulator_of, tables_of
from tofcorr.diagnosis.rerun.noisy_frames import observables_of
from tofcorr.diagnosis.rerun.whole_patterns import whole_patterns
from tofcorr.diagnosis.sums.study import Study
from tofcorr.observables import Observables
from tofcorr.simulation.options import SimulatorOptions


def conclude(
    prepared: Prepared, simulator: GivenSimulator | None, begin: Callable[[str], object]
) -> DiagnosisResult:
    """Return all findings; their verdict is that of the gap, without doubts about the recording.

    Args:
        prepared: The recording, before any effect was named.
        simulator: The simulator under diagnosis; None: one is fitted to the recording.
        begin: Called with the name of each stage.
    """
    study, options = prepared.study, prepared.study.options
    given = None if simulator is None else simulator.options
    begin("naming effects")
    generator = torch.Generator().manual_seed(options.seed + 1)
    resamples = draw_resamples(study, generator)
    named = name_in_two(study, resamples)
    rendered = simulator is not None and given is None
    with_effects = None if rendered else simulator_of(study, named, given)

    pieces = {}
    if options.simulate_anew:
        pieces = pieces_of_anew(study, named, given, with_effects, generator, resamples)
    judged = judge(prepared, named, simulator, resamples, begin)
    patterns = whole_patterns(study, named, given)
    anew = Anew(**{name: piece() for name, piece in pieces.items()})
    observables = _observables(prepared, simulator)
    if patterns and with_effects is not None:
        with_effects = simulator_of(study, named, given, patterns)
    missing = dict(study.candidates.missing)
    return DiagnosisResult(
        verdict=write_verdict(named, judged.gap, judged.remainder, judged.shares),
        causes=list_causes(study, named, judged.shares),
        remarks=list_remarks(
            named,
            judged.gap,
            lone_poses(study, judged.gap.floor),
            judged.remainder,
            judged.detectable,
            list(missing),
        ),
        simulator_kind="fitted" if simulator is None else simulator.kind,
        warnings=(
            *prepared.warnings,
            *(() if rendered else _simulator_warnings(study, named, given)),
        ),
        detected=named.tested and (bool(named.names) or judged.remainder.unknown),
        p_value=least_p_value(study, named.first),
        effects=named.names,
        cause_sets=named.cause_sets,
        likeliest=named.likeliest,
        refined_terms=named.refined_terms,
        tested=named.tested,
        where=judged.stages[1].found_where,
        outliers=prepared.outliers,
        ranking=rank_effects(study, named),
        missing=missing,
        simulator=with_effects,
        options=options,
        evidence=Evidence(study=study, named=named, patterns=patterns),
        observables=observables,
        **vars(judged),
        **vars(anew),
    )


def _observables(prepared: Prepared, simulator: GivenSimulator | None) -> Observables:
    """Compare noise, missing pixels and amplitude of recording and simulator."""
    options, recording = prepared.study.options, prepared.study.observations.recording
    frames = None
    if simulator is not None:
        frames = simulator.options or simulator.rendered_frames(recording)
    return observables_of(recording, frames, seed=options.seed + 3, level=options.tests.level)


def _simulator_warnings(
    study: Study, named: NamedEffects, given: SimulatorOptions | None
) -> list[str]:
    """Name the base terms that simulator_with_effects.yaml cannot hold."""
    beyond = tables_of(study, named, given).beyond
    if not beyond:
        return []
    return [
        f"simulator_with_effects.yaml lacks these terms of the base model: {', '.join(beyond)}. "
        "The simulator has no table for them; the findings include them."
    ]
