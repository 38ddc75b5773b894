"""Which effect is named, and what is said where none can be."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import diagnosed_recordings
import numpy as np
import pytest
import torch
from diagnosis.comparisons import effect_test, model_of, resamples_of

from tofcorr.data.recording import Recording
from tofcorr.diagnosis.findings.effect_comparison import (
    EffectComparison,
    compare_effects,
    least_p_value,
)
from tofcorr.diagnosis.findings.gap import (
    OpenSet,
    judge_remainder,
    measure_gap,
    name_in_two,
)
from tofcorr.diagnosis.findings.naming import (
    NamedEffects,
    name_effects,
    next_effect,
    refined,
    simplest,
)
from tofcorr.diagnosis.options import DiagnosisOptions
from tofcorr.diagnosis.prepare import prepare
from tofcorr.diagnosis.sums.base import SimulatorError
from tofcorr.diagnosis.sums.study import Study
from tofcorr.errors import ConfigError

EFFECTS: dict[str, dict[str, Any]] = {
    "wiggling": {"sin_4": 0.012, "cos_8": 0.006},
    "room_temperature": {"per_degree": 0.004},
    "ambient_light": {"linear": 0.012, "reference_counts": 800.0},
    "incidence_angle": {"secant": 0.06},
    "row_column_pattern": {"row_rms_m": 0.004, "column_rms_m": 0.004, "height": 24, "width": 32},
    "robot_kinematics": {"scale_zx": 0.012, "scale_zy": -0.01},
    "target_shape": {"x2_y0": 0.01, "x1_y2": 0.008},
}
# Of effects of distance, of the scene and of the robot one each; the others are long checks.
FIRST = {"wiggling", "incidence_angle", "robot_kinematics"}


def _selected(recording: Recording, **changes: Any) -> tuple[Study, NamedEffects]:
    study = prepare(recording, DiagnosisOptions(**changes), None).study
    return study, name_effects(study)


def test_an_error_carried_from_other_poses_hides_what_a_form_error_may_be(
    nothing_study: Study,
) -> None:
    pixels = len(nothing_study.observations.measured)
    there = SimulatorError(
        error=torch.zeros(pixels),
        sigma=torch.zeros(pixels),
        tool_from_camera=torch.eye(4),
        uncertain=torch.zeros(pixels, 0),
    )
    sizes = [
        replace(nothing_study, fit=replace(nothing_study.fit, known=known)).material_mm
        for known in (None, there, replace(there, carried=True))
    ]
    tests = nothing_study.options.tests
    assert sizes == [tests.material_mm, tests.material_mm, tests.form_tolerance_mm]


def _judged(study: Study, named: NamedEffects) -> OpenSet:
    return judge_remainder(study, named, measure_gap(study, named, resamples_of(study)))


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=() if name in FIRST else pytest.mark.slow)
        for name in sorted(EFFECTS)
    ],
)
def test_a_strong_effect_is_named_or_is_in_the_cause_set(name: str, tmp_path: Path) -> None:
    effect = {"name": name} | EFFECTS[name]
    _, named = _selected(diagnosed_recordings.recorded(tmp_path / name, 40, [effect]))
    assert len(named.names) == 1
    assert name in named.cause_sets[0]
    # Robot, target and incidence angle look alike before one wall, and multipath has many forms.
    assert len(named.cause_sets[0]) <= 4


def test_two_effects_are_both_named(tmp_path: Path) -> None:
    pair = [{"name": "integration_time", "log_1": 0.006}, {"name": "wiggling", "sin_8": 0.006}]
    recording = diagnosed_recordings.recorded(tmp_path / "pair", 41, pair)
    _, named = _selected(recording)
    covered = {name for members in named.cause_sets for name in members}
    assert {"integration_time", "wiggling"} <= covered
    assert len(named.names) == 2


def test_nothing_is_named_where_nothing_is_missing(
    nothing_study: Study, nothing_named: NamedEffects
) -> None:
    assert nothing_named.names == nothing_named.with_probes == ()
    assert not _judged(nothing_study, nothing_named).unknown


def test_of_causes_that_close_the_same_the_simplest_significant_one_is_named() -> None:
    effects = {
        "found": (1.0, 9.0, 7),
        "simpler": (0.99, 8.0, 3),
        "chance": (1.3, 0.2, 1),
        "weaker": (0.7, 8.0, 1),
    }
    tests = {
        name: effect_test(name, closed * torch.ones(1).double(), gain=gain, size=size)
        for name, (closed, gain, size) in effects.items()
    }
    comparison = EffectComparison(chosen=(), squares=torch.zeros(2), tests=tests, probes={})
    assert simplest(comparison, list(tests), 0.05) == "simpler"


def test_a_refined_base_term_is_named_once_it_closes_much(time_study: Study) -> None:
    last = compare_effects(time_study, (), flips=False, maps=False)
    model = model_of(time_study, last, refined_terms=("integration_time", "distance"))
    found = refined(model)
    assert (found.names, found.refined_terms) == (("integration_time",), ("distance",))


def test_few_poses_are_ranked_but_not_tested(time_missing: Recording) -> None:
    study = prepare(time_missing, DiagnosisOptions(), None).study
    options = study.options.model_copy(
        update={"tests": study.options.tests.model_copy(update={"least_images": 60})}
    )
    named = name_effects(replace(study, options=options))
    assert not named.tested
    assert named.names == ()
    assert named.first.ordered()[0].name == "integration_time"


@pytest.mark.parametrize(
    ("kind", "trace"),
    [
        ("third frame", "repeats every few frames"),
        ("stripes", "is similar within rows of an image"),
    ],
)
def test_what_no_effect_explains_is_unknown_and_described(
    kind: str, trace: str, tmp_path: Path
) -> None:
    recording = diagnosed_recordings.recorded(tmp_path / "odd", 42)
    depth = np.load(recording.path / "depth.npy")
    random = np.random.default_rng(42)
    if kind == "third frame":
        depth[::3] += 0.006
    else:
        phase = random.uniform(0, 2 * np.pi, (len(depth), 1, 1))
        depth += 0.006 * np.sin(np.arange(24)[None, :, None] * 0.9 + phase).astype(np.float32)
    np.save(recording.path / "depth.npy", depth)
    study, named = _selected(Recording.open(recording.path))
    remains = _judged(study, named)
    assert named.names == ()
    assert remains.unknown
    assert trace in remains.fingerprint


def test_an_absent_base_term_is_named(tmp_path: Path) -> None:
    bowl = {"sensor": {"delays": {"pixel": {"bowl_mm": 40.0, "row_line_mm": 8.0}}}}
    recording = diagnosed_recordings.recorded(tmp_path / "bowl", 43, [], bowl)
    base = {"terms": [{"kind": "distance_polynomial"}, {"kind": "amplitude_polynomial"}]}
    _, named = _selected(recording, base=base)
    assert named.names[:1] == ("pixel",)


def test_an_effect_whose_column_is_missing_is_not_tested(tmp_path: Path) -> None:
    hidden = {"conditions": {"recorded": ["pose_id", "ambient"]}}
    recording = diagnosed_recordings.recorded(
        tmp_path / "hidden", 44, [{"name": "room_temperature", "per_degree": 0.004}], hidden
    )
    study, named = _selected(recording, catalogue=("room_temperature", "warm_up", "ambient_light"))
    assert study.candidates.missing["room_temperature"] == ["room_temperature_c"]
    assert "room_temperature" not in {name for members in named.cause_sets for name in members}


def test_an_unknown_effect_is_refused(nothing_missing: Recording) -> None:
    with pytest.raises(ConfigError, match="no effect 'wigling'"):
        prepare(nothing_missing, DiagnosisOptions(leave_out=("wigling",)), None)


@pytest.mark.parametrize(("closed_mm", "expected"), [(0.02, 1.0), (2.0, 0.05)])
def test_a_significant_but_tiny_effect_is_no_gap(
    nothing_study: Study, closed_mm: float, expected: float
) -> None:
    """Held-out likelihood may gain where millimetres do not."""
    closed = (closed_mm * 1e-3) ** 2 * nothing_study.system.sums.count
    test = effect_test("lens", closed, gain=50.0, null=torch.linspace(-1.0, 1.0, 19))
    comparison = EffectComparison(
        chosen=(), squares=nothing_study.system.sums.ols.square, tests={"lens": test}, probes={}
    )
    assert least_p_value(nothing_study, comparison) == pytest.approx(expected)


def test_an_effect_that_comes_back_keeps_its_place(nothing_study: Study) -> None:
    both = model_of(nothing_study).naming("wiggling").naming("amplitude")
    again = replace(both, names=("amplitude",)).naming("wiggling")
    assert again.names == ("wiggling", "amplitude")
    swapped = again.naming("lens", instead_of="wiggling")
    assert swapped.names == ("lens", "amplitude")
    assert swapped.naming("wiggling").names == ("wiggling", "lens", "amplitude")


def test_a_refined_base_term_is_not_named_without_being_significant(
    time_study: Study, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(EffectComparison, "family_p_value", lambda *_: 0.5)
    model = model_of(time_study, refined_terms=("integration_time",))
    found = refined(model)
    assert (found.names, found.refined_terms) == ((), ("integration_time",))


def test_an_effect_that_leads_back_to_an_earlier_model_is_not_tried_again(
    time_study: Study, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two effects once dropped one another in turn, until the steps were spent."""
    steps: list[set[str]] = []

    def dropping_the_other(model: NamedEffects) -> NamedEffects:
        steps.append(set(model.names))
        first, *_ = model.order
        left = tuple(name for name in model.names if name != first)
        return replace(model, names=left, order=model.order[::-1])

    def the_other(model: NamedEffects, *_: object, **__: object) -> tuple[str, bool] | None:
        names = [name for name in ("saturation", "amplitude") if name not in model.names]
        names = [name for name in names if name not in model.rejected]
        return (names[0], True) if names else None

    monkeypatch.setattr("tofcorr.diagnosis.findings.naming.next_effect", the_other)
    monkeypatch.setattr("tofcorr.diagnosis.findings.naming.refined", dropping_the_other)
    named = name_effects(time_study)
    assert named.names == ("amplitude",)
    assert steps == 2 * [{"saturation", "amplitude"}]


@pytest.mark.parametrize(("p_value", "expected"), [(0.5, "lens"), (0.003, "integration_time")])
def test_an_effect_is_swapped_for_a_better_one_only_if_that_is_significant(
    p_value: float, expected: str, time_study: Study, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(EffectComparison, "family_p_value", lambda *_: p_value)
    monkeypatch.setattr("tofcorr.diagnosis.findings.naming.least_closed", lambda *_, **__: -1e9)
    model = model_of(time_study).naming("lens")
    assert refined(model).names == (expected,)


GAP = 4e-6  # Two millimetres, squared.


def _comparison(study: Study, closes: float, p_value: float) -> EffectComparison:
    """An effect that closes a share of the gap, among others that reach more by chance."""
    square = GAP * study.sums.count
    noise = study.fit.floor**2 * study.sums.count
    draws = torch.linspace(0.0, 1.0, 99, dtype=torch.float64)
    lens = effect_test("lens", closes * square, gain=1.0 - p_value, null=draws)
    # It often gains more by chance than the lens does, in units of its own spread.
    often = draws.flip(0) ** 40 + draws**40
    motion = effect_test("motion", 0 * square, gain=-1.0, null=often)
    tests = {"lens": lens, "motion": motion}
    return EffectComparison(chosen=(), squares=noise + square, tests=tests, probes={})


@pytest.mark.parametrize(
    ("closes", "p_value", "certain", "named"),
    [
        (0.9, 0.02, False, False),
        (0.9, 0.02, True, True),
        (0.4, 0.02, True, False),  # Less than half of the gap.
        (0.9, 0.20, True, False),  # Not even significant by itself.
    ],
)
def test_a_certain_gap_is_named_by_what_is_significant_alone_and_explains_most_of_it(
    closes: float, p_value: float, certain: bool, named: bool, nothing_study: Study
) -> None:
    compared = _comparison(nothing_study, closes, p_value)
    assert compared.naming_p_value("lens") > 0.05
    found = next_effect(model_of(nothing_study, compared, certain=certain))
    assert (found is not None) == named


def test_a_second_effect_is_not_named_on_less_evidence(nothing_study: Study) -> None:
    compared = _comparison(nothing_study, 0.9, 0.02)
    model = model_of(nothing_study, compared, names=("warm_up",), certain=True)
    assert next_effect(model) is None


@pytest.mark.parametrize(
    ("names", "likeliest", "unknown", "again"),
    [
        ((), ("lens",), True, True),
        ((), ("lens",), False, False),  # Nothing says that there is a gap.
        ((), (), True, False),  # No effect would be named.
        (("motion",), ("lens",), True, False),
    ],
)
def test_effects_are_named_again_only_where_none_is_and_a_gap_is_certain(
    names: tuple[str, ...],
    likeliest: tuple[str, ...],
    unknown: bool,
    again: bool,
    nothing_study: Study,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[bool] = []

    def named(_: Study, *, certain: bool = False) -> SimpleNamespace:
        asked.append(certain)
        return SimpleNamespace(names=names, likeliest=likeliest)

    replaced = {
        "name_effects": named,
        "measure_gap": lambda *_: None,
        "judge_remainder": lambda *_: SimpleNamespace(unknown=unknown),
    }
    for name, function in replaced.items():
        monkeypatch.setattr(f"tofcorr.diagnosis.findings.gap.{name}", function)
    name_in_two(nothing_study, torch.ones(1, nothing_study.observations.num_units).double())
    assert asked == ([False, True] if again else [False])
