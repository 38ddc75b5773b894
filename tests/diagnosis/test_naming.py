"""Which effect is named, and what is said where none can be."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from diagnosed_recordings import TIME, altered, recorded
from diagnosis.resamples import resamples_of

from tofcorr.data.recording import Recording
from tofcorr.diagnosis.diagnose import prepare
from tofcorr.diagnosis.findings.gap import OpenSet, judge_remainder, measure_gap
from tofcorr.diagnosis.findings.naming import NamedEffects, name_effects
from tofcorr.diagnosis.options import DiagnosisOptions
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


def test_an_error_carried_from_other_poses_hides_a_form_error(nothing_study: Study) -> None:
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
    _, named = _selected(recorded(tmp_path / name, 40, [effect]))
    assert len(named.names) == 1
    assert name in named.cause_sets[0]
    # Robot, target and incidence angle look alike before one wall, and multipath has many forms.
    assert len(named.cause_sets[0]) <= 4


def test_two_effects_are_both_named(tmp_path: Path) -> None:
    pair = [TIME, {"name": "wiggling", "sin_8": 0.006}]
    _, named = _selected(recorded(tmp_path / "pair", 41, pair))
    covered = {name for members in named.cause_sets for name in members}
    assert {"integration_time", "wiggling"} <= covered
    assert len(named.names) == 2


def test_nothing_is_named_where_nothing_is_missing(
    nothing_study: Study, nothing_named: NamedEffects
) -> None:
    assert nothing_named.names == nothing_named.probes == ()
    assert not _judged(nothing_study, nothing_named).unknown


def test_few_poses_are_ranked_but_not_tested(time_study: Study) -> None:
    tests = time_study.options.tests.model_copy(update={"least_images": 60})
    options = time_study.options.model_copy(update={"tests": tests})
    named = name_effects(replace(time_study, options=options))
    assert not named.tested
    assert named.names == ()
    assert named.ranking[0] == "integration_time"


@pytest.mark.parametrize(
    ("kind", "trace"),
    [
        ("third frame", "repeats every few frames"),
        ("stripes", "is similar within rows of an image"),
    ],
)
def test_what_no_effect_explains_is_unknown_in_words(kind: str, trace: str, tmp_path: Path) -> None:
    recording = recorded(tmp_path / "odd", 42)
    frame = np.arange(recording.num_frames)[:, None, None]
    if kind == "third frame":
        off = frame % 3 == 0
    else:
        phase = np.random.default_rng(42).uniform(0, 2 * np.pi, frame.shape)
        off = np.sin(np.arange(24)[:, None] * 0.9 + phase)
    study, named = _selected(altered(recording, lambda depth: depth + 0.006 * off))
    remains = _judged(study, named)
    assert named.names == ()
    assert remains.unknown
    assert trace in remains.fingerprint


def test_an_absent_base_term_is_named(tmp_path: Path) -> None:
    bowl = {"sensor": {"delays": {"pixel": {"bowl_mm": 40.0, "row_line_mm": 8.0}}}}
    recording = recorded(tmp_path / "bowl", 43, [], bowl)
    base = {"terms": [{"kind": "distance_polynomial"}, {"kind": "amplitude_polynomial"}]}
    _, named = _selected(recording, base=base)
    assert named.names[:1] == ("pixel",)


def test_an_effect_whose_column_is_missing_is_not_tested(tmp_path: Path) -> None:
    hidden = {"conditions": {"recorded": ["pose_id", "ambient"]}}
    effect = {"name": "room_temperature"} | EFFECTS["room_temperature"]
    recording = recorded(tmp_path / "hidden", 44, [effect], hidden)
    study, named = _selected(recording, catalogue=("room_temperature", "warm_up", "ambient_light"))
    assert study.missing["room_temperature"] == ["room_temperature_c"]
    assert "room_temperature" not in {name for members in named.cause_sets for name in members}


def test_an_unknown_effect_is_refused() -> None:
    with pytest.raises(ConfigError, match="'wigling' is no effect"):
        DiagnosisOptions.from_mapping({"leave_out": ["wigling"]}, "diagnose.yaml")
