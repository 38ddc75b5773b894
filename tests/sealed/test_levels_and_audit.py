"""Laws of the small recordings of `levels` and of the cases of an audit, and of their tables."""

from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from benchmarks import levels
from benchmarks.renewed import ranges
from benchmarks.renewed.cases import wanted_by
from benchmarks.renewed.recording import Data, read
from benchmarks.sealed.answers import Outcome, Said, load
from benchmarks.sealed.oracle import Oracle
from benchmarks.sealed.remains import true_gaps_mm
from benchmarks.withheld.__main__ import RIGHT, SET, WARNING, WRONG, audit_table, judged
from benchmarks.withheld.tiers import AUDIT, OFF_BY, OFF_SHARE, write_case
from tofcorr.data.recording import Recording
from tofcorr.diagnosis.diagnose import prepare
from tofcorr.diagnosis.findings.naming import NamedEffects
from tofcorr.diagnosis.options import DiagnosisOptions

TRUTH = ("multipath",)


def test_the_noise_that_is_stated_is_the_noise_that_is_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Within a tenth, for most pixels: the darkest have a noise of their own law."""
    monkeypatch.setitem(ranges.RANGES, "spatial_filter", {"gauss of 1.2 pixels": 1.0})
    monkeypatch.setitem(ranges.RANGES, "tails", {np.inf: 1.0})
    for number in range(3):
        case = levels.write_case(5, "nothing", number, tmp_path / str(number))
        data = read(tmp_path / str(number))
        made = (data.depth - case.truth.expected)[data.valid]
        middle = np.quantile(np.abs(made / case.noise[data.valid]), 0.6827)
        assert middle == pytest.approx(1.0, rel=0.1)


def test_a_case_depends_on_seed_kind_and_number_alone(tmp_path: Path) -> None:
    first = levels.write_case(5, "outside", 1, tmp_path / "a")
    levels.write_case(5, "nothing", 0, tmp_path / "b")
    again = levels.write_case(5, "outside", 1, tmp_path / "c")
    assert first.described() == again.described()
    np.testing.assert_array_equal(first.truth.expected, again.truth.expected)
    assert 3.0 * 0.9 < max(first.sizes_mm.values()) < 6.0 * 1.1


def test_the_true_gap_of_distances_without_noise_is_all_that_a_model_leaves(tmp_path: Path) -> None:
    """Over the pixels as over the sums of the poses."""
    levels.write_case(5, "nothing", 0, tmp_path / "one")
    recording = Recording.open(tmp_path / "one")
    study = prepare(recording, DiagnosisOptions(catalogue=("wiggling",))).study
    nothing = cast(NamedEffects, SimpleNamespace(names=()))
    gaps = true_gaps_mm(study, nothing, np.zeros(read(tmp_path / "one").depth.shape))
    left = 1e3 * study.left_out_mean_square(()) ** 0.5
    assert gaps == pytest.approx((left, left), rel=1e-6)


def test_two_effects_stand_in_one_recording_that_shows_both(tmp_path: Path) -> None:
    case = levels.write_case(5, "pair", 3, tmp_path / "one")
    one, other = (hook.form for hook in case.hooks)
    wanted = wanted_by([one, other])
    assert wanted.items() >= {k: v for k, v in one.wanted.items() if k != "logged"}.items()
    assert set(wanted.get("logged", ())) >= set(other.wanted.get("logged", ()))
    assert set(case.truth.fields) == set(case.sizes_mm) == {one.effect, other.effect}
    assert min(case.sizes_mm.values()) > 0


def test_tables_count_what_is_said_and_what_intervals_hold() -> None:
    sensor = {"width": 32, "height": 24, "spatial_filter": "none", "temporal_filter": 0.0}
    row = {
        "kind": "nothing",
        "must_find": [],
        "unknown": True,
        "design": {"poses": 20, "frames": 20, "robot": 5e-4, "far": 2.0, "repeated": 0.0}
        | {"mask": "RANSAC", "scene": "wall"},
        "sensor": sensor | {"rounding_mm": 0.0, "sun": False, "frequencies": [2e7]},
        "names": [],
        "sets": [],
        "tested": True,
        "sizes_mm": {},
        "probabilities": {"lens": 0.25, "any_time": 0.4},
        "intervals": {"before": [0.5, 1.0]},
        "before_all_alike_mm": 2.0,
        "held": {"before": True, "after": False, "closed": True},
    }
    text = levels.tables([row, row | {"unknown": False}])
    assert "| all |  | 2 | 0.000 [0.000, 0.658] | 0.500 [0.095, 0.905] | 0.500" in text
    assert "| nothing | 2 | 1.000 [0.342, 1.000] | 0.000 [0.000, 0.658] | 1.000" in text
    assert "| 0.2 to 0.4 | 2 | 0.000 [0.000, 0.658] | 0.250 |" in text
    assert "| Brier score | 2 | 0.0625 |" in text
    pair = row | {
        "kind": "pair",
        "names": ["lens", "backlash", "pixel"],
        "sets": [["lens"], ["backlash", "lens"], ["pixel"]],
        "sizes_mm": {"lens": 3.0, "robot_kinematics": 3.0, "warm_up": 1.0},
        "must_find": ["lens", "robot_kinematics", "warm_up"],
    }
    text = levels.tables([pair, pair | {"names": ["lens"], "sets": [["lens"]]}])
    shares = "0.500 [0.188, 0.812] | 1.000 [0.610, 1.000] | 0.500 [0.095, 0.905] | 1.000"
    assert f"| pair | 2 | {shares} [0.342, 1.000] | 1.000 [0.342, 1.000] | 1.25 |" in text


def audited(name: str, folder: Path) -> tuple[Data, np.ndarray]:
    """A recording of a case of the audit, and its distances without noise."""
    (entry,) = write_case(8, "L", [*AUDIT].index(name), folder)
    return read(folder / "recordings" / entry["id"]), load(folder, entry["id"], "expected")


def test_the_share_of_pixels_that_is_asked_for_is_far_off(tmp_path: Path) -> None:
    data, expected = audited("3 % of the pixels 0.7 m off", tmp_path)
    error = (data.depth - expected)[data.valid]
    far = np.abs(error - OFF_BY) < 0.1
    assert far.mean() == pytest.approx(OFF_SHARE, abs=4 * np.sqrt(OFF_SHARE / far.size))
    assert np.abs(error[~far]).max() < 0.1


def test_planes_by_a_board_hold_the_distances_up_to_its_errors(tmp_path: Path) -> None:
    data, expected = audited("board poses 1 mm / 2 mrad, no robot, nothing missing", tmp_path)
    assert not data.moves
    slope = np.einsum("nj,hwj->nhw", data.normal, data.rays)
    off = expected + data.offset[:, None, None] / slope
    left = np.abs(off - np.median(off[data.valid]))[data.valid]
    assert 0 < np.median(left) < 0.05


def said(*sets: Sequence[str], unknown: bool = False, warning: str = "") -> Said:
    report = {"warnings": [warning]}
    return Said(sets=tuple(map(frozenset, sets)), unknown=unknown, report=report)


@pytest.mark.parametrize(
    ("truth", "answer", "needed", "right"),
    [
        (TRUTH, said(TRUTH), "", RIGHT),
        (TRUTH, said(("lens", "multipath")), "", SET),
        (TRUTH, said(unknown=True), "", WARNING),
        (TRUTH, said(), "", WRONG),
        (TRUTH, said(TRUTH, ("lens",), unknown=True), "", WRONG),
        (("lens", "multipath"), said(("lens",)), "", WRONG),
        ((), said(), "", RIGHT),
        ((), said(unknown=True), "", WRONG),
        ((), said(("lens",)), "", WRONG),
        ((), said(), "outliers", WRONG),
        ((), said(warning="left out as outliers"), "outliers", WARNING),
    ],
)
def test_answers_are_judged_by_what_is_true(
    truth: Sequence[str], answer: Said, needed: str, right: str
) -> None:
    case = {"tier": "L", "row": "two effects", "says": needed}
    sizes = dict.fromkeys(truth, 5.0)
    one = Outcome("r", {"case": case, "sizes_mm": sizes}, Oracle(5.0, 1.0, {}), answer)
    assert judged(one) == right
    found = [int(right == each) or "" for each in (RIGHT, SET, WARNING, WRONG)]
    assert "| two effects | 1 | {} | {} | {} | {} |".format(*found) in audit_table([one])
