"""Laws of the small recordings on which levels and coverage are measured."""

from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from benchmarks.levels import cases
from benchmarks.levels.pairs import pairs_table
from benchmarks.levels.tables import tables
from benchmarks.renewed.generator import ranges
from benchmarks.renewed.remains import true_gaps_mm
from benchmarks.withheld.oracle import ask, counted
from benchmarks.withheld.reading import read
from tofcorr.data.recording import Recording
from tofcorr.diagnosis.findings.naming import NamedEffects
from tofcorr.diagnosis.options import DiagnosisOptions
from tofcorr.diagnosis.prepare import prepare


@pytest.fixture(autouse=True)
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cases, "IMAGES", {(32, 24): 1.0})
    monkeypatch.setattr(cases, "FRAMES", {kind: {15: 1.0} for kind in ("nothing", "effect")})
    monkeypatch.setattr(ranges, "SPATIAL_FILTER", {"gauss of 1.2 pixels": 1.0})
    monkeypatch.setattr(ranges, "TAILS", {np.inf: 1.0})


def test_the_noise_that_is_stated_is_the_noise_that_is_made(tmp_path: Path) -> None:
    """Within a tenth, for most pixels: the darkest have a noise of their own law."""
    for number in range(3):
        case = cases.write_case(5, "nothing", number, tmp_path / str(number))
        data = read(tmp_path / str(number))
        made = (data.depth - case.expected)[data.valid]
        middle = np.quantile(np.abs(made / case.noise[data.valid]), 0.6827)
        assert middle == pytest.approx(1.0, rel=0.1)


def test_a_case_depends_on_seed_kind_and_number_alone(tmp_path: Path) -> None:
    images = ranges.IMAGES
    first = cases.write_case(5, "outside", 1, tmp_path / "a")
    cases.write_case(5, "nothing", 0, tmp_path / "b")
    again = cases.write_case(5, "outside", 1, tmp_path / "c")
    assert first.about == again.about
    np.testing.assert_array_equal(first.expected, again.expected)
    assert first.about["effect"] in {form.effect for form in cases.OUTSIDE}
    assert 3.0 * 0.9 < first.size_mm < 6.0 * 1.1
    assert ranges.IMAGES is images


def test_pixels_that_count_alike_give_the_gap_of_all_alike(tmp_path: Path) -> None:
    case = cases.write_case(5, "nothing", 0, tmp_path / "one")
    data = read(tmp_path / "one")
    alike = ask(data, {}, case.expected, np.full(case.noise.shape, 0.3))
    assert alike.counted is not None
    assert alike.counted.before_mm == pytest.approx(alike.plain.before_mm, rel=1e-9)
    assert counted(np.array([0.0, 5e-3])).tolist() == [1.0, 0.5]


def test_the_true_gap_of_distances_without_noise_is_all_that_a_model_leaves(tmp_path: Path) -> None:
    """Over the pixels as over the sums of the poses."""
    cases.write_case(5, "nothing", 0, tmp_path / "one")
    recording = Recording.open(tmp_path / "one")
    study = prepare(recording, DiagnosisOptions(catalogue=("wiggling",))).study
    nothing = cast(NamedEffects, SimpleNamespace(names=()))
    gaps = true_gaps_mm(study, nothing, np.zeros(read(tmp_path / "one").depth.shape))
    left = 1e3 * study.left_out_mean_square(()) ** 0.5
    assert gaps == pytest.approx((left, left), rel=1e-6)


def test_tables_count_what_is_said_and_what_intervals_hold() -> None:
    about = {
        "poses": 20,
        "design": {"robot": 5e-4, "mask": "RANSAC", "repeated": 0.0},
        "sensor": {
            "width": 32,
            "height": 24,
            "spatial_filter": "none",
            "temporal_filter": 0.0,
            "rounding_mm": 0.0,
            "sun": False,
            "frequencies": [2e7],
        },
    }
    said = {"names": [], "sets": [], "tested": True, "p_value": 0.02, "p_values": {"waves": 0.02}}
    gap = {
        "intervals": {"before": [0.5, 1.0]},
        "before_all_alike_mm": 2.0,
        "held": {"before": True, "after": False, "closed": True},
    }
    row = {"kind": "nothing", "must_find": [], "unknown": True} | about | said | gap
    text = tables([row, row | {"unknown": False}])
    assert "| all |  | 2 | 0.000 [0.000, 0.658] | 0.500 [0.095, 0.905] | 0.500" in text
    assert "| nothing | 2 | 1.000 [0.342, 1.000] | 0.000 [0.000, 0.658] | 1.000" in text
    assert "| waves | 0.000 | 1.000 | 1.000" in text


def test_two_effects_stand_in_one_recording_that_shows_both(tmp_path: Path) -> None:
    one, other = cases._forms_of(5, "pair", 3)
    wanted = cases.wanted_by([one, other])
    assert wanted.items() >= {k: v for k, v in one.wanted.items() if k != "logged"}.items()
    assert set(wanted.get("logged", ())) >= set(other.wanted.get("logged", ()))
    case = cases.write_case(5, "pair", 3, tmp_path / "one")
    assert set(case.fields) == set(case.sizes_mm) == {one.effect, other.effect}
    assert min(case.sizes_mm.values()) > 0


def test_the_table_of_pairs_counts_names_and_sets() -> None:
    row = {
        "names": ["lens", "backlash", "pixel"],
        "sets": [["lens"], ["backlash", "lens"], ["pixel"]],
        "sizes_mm": {"lens": 3.0, "robot_kinematics": 3.0, "warm_up": 1.0},
        "must_find": ["lens", "robot_kinematics", "warm_up"],
    }
    text = pairs_table([row, row | {"names": ["lens"], "sets": [["lens"]]}])
    assert "| effects named: right, wrong, missed | 3, 1, 1 |" in text
    assert "| F1 of the names | 0.750 |" in text
    assert "in a set | 0.750 [0.301, 0.954], n = 4 |" in text
    assert "| a single wrong name | 0.500 [0.095, 0.905], n = 2 |" in text
    assert "| size of a set | 1.25 |" in text
