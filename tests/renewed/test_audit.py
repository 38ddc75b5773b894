"""Laws of the audit's table: what is done to recordings, and how answers are judged."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from benchmarks.audit import rows
from benchmarks.audit.faults import OFF_BY, OFF_SHARE
from benchmarks.audit.judged import RIGHT, SET, WARNING, WRONG, judged
from benchmarks.audit.rows import ROWS, write_draw
from benchmarks.withheld.reading import read

TRUTH = ("multipath",)


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(rows.PLAIN, "IMAGES", {(32, 24): 1.0})
    monkeypatch.setitem(rows.PLAIN, "FRAMES", {6: 1.0})


def test_what_makes_the_recordings_does_not_import_the_program() -> None:
    for name in ("rows", "forms", "faults"):
        source = Path(rows.__file__).with_name(f"{name}.py").read_text()
        assert "tofcorr." not in source, name


def said(*sets: Sequence[str], unknown: bool = False, warning: str = "") -> dict[str, object]:
    return {"sets": sets, "unknown": unknown, "warnings": [warning]}


def test_the_share_of_pixels_that_is_asked_for_is_far_off(tmp_path: Path) -> None:
    made = write_draw(7, "far_pixels", 0, tmp_path / "one")
    data = read(tmp_path / "one")
    error = (data.depth - made.expected)[data.valid]
    far = np.abs(error - OFF_BY) < 0.1
    assert far.mean() == pytest.approx(OFF_SHARE, abs=4 * np.sqrt(OFF_SHARE / far.size))
    assert np.abs(error[~far]).max() < 0.1


def test_planes_by_a_board_hold_the_distances_up_to_its_errors(tmp_path: Path) -> None:
    made = write_draw(7, "board_poses", 0, tmp_path / "one")
    data = read(tmp_path / "one")
    assert not data.moves
    slope = np.einsum("nj,hwj->nhw", data.normal, data.rays)
    predicted = -data.offset[:, None, None] / slope
    base = np.median((made.expected - predicted)[data.valid])
    left = np.abs(made.expected - predicted - base)[data.valid]
    assert 0 < np.median(left) < 0.05


def test_a_draw_depends_on_seed_row_and_number_alone(tmp_path: Path) -> None:
    first = write_draw(7, "height", 1, tmp_path / "a")
    write_draw(7, "no_amplitude", 0, tmp_path / "b")
    again = write_draw(7, "height", 1, tmp_path / "c")
    np.testing.assert_array_equal(first.expected, again.expected)
    assert not (tmp_path / "b" / "amplitude.npy").exists()
    low, high = ROWS["height"].size_mm.low, ROWS["height"].size_mm.high
    assert 0.8 * low < first.sizes_mm["multipath"] < 1.2 * high


def test_of_an_effect_a_name_is_right_a_set_or_unknown_will_do_and_a_wrong_name_will_not() -> None:
    assert judged(TRUTH, said(TRUTH), "") == RIGHT
    assert judged(TRUTH, said(("lens", "multipath")), "") == SET
    assert judged(TRUTH, said(unknown=True), "") == WARNING
    assert judged(TRUTH, said(), "") == WRONG
    assert judged(TRUTH, said(TRUTH, ("lens",), unknown=True), "") == WRONG
    assert judged(("lens", "multipath"), said(("lens",)), "") == WRONG


def test_of_nothing_silence_is_right_unless_a_warning_is_needed() -> None:
    assert judged((), said(), "") == RIGHT
    assert judged((), said(unknown=True), "") == WRONG
    assert judged((), said(("lens",)), "") == WRONG
    assert judged((), said(), "outliers") == WRONG
    assert judged((), said(warning="left out as outliers"), "outliers") == WARNING
