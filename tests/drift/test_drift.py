"""A camera that reads as it did is not accused, one that does not is found out."""

import html
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from drift.few_walls import FEW, Walls, sensor
from optional import present
from running import Program
from shown_pages import fetched, silent
from simulated_walls import CAMERA, simulated_wall

import tofcorr
from tofcorr.correction.state import CalibrationState, save_calibration
from tofcorr.drift.check import check_drift
from tofcorr.drift.offset import Wall
from tofcorr.drift.result import DriftResult
from tofcorr.fit.reference import Reference
from tofcorr.pixels.dataset import Dataset

Check = Callable[..., DriftResult]


@pytest.fixture
def checked(state: CalibrationState, reference: Reference, walls: Walls) -> Check:
    """Check a few frames, by seed and shift, against the reference with some changes."""

    def check(
        wall: Wall = "per_image", seed: int = 11, shift: float = 0.0, **changes: Any
    ) -> DriftResult:
        known = reference.model_copy(update=changes)
        return check_drift(state, walls(seed, shift), wall, reference=known)

    return check


def width(found: DriftResult) -> float:
    return found.interval[1] - found.interval[0]


@pytest.mark.parametrize("wall", ["recorded", "one", "per_image"])
@pytest.mark.parametrize("seed", range(11, 15))
def test_a_camera_that_holds_is_never_accused(checked: Check, wall: Wall, seed: int) -> None:
    found = checked(wall, seed)
    assert found.verdict in (("holds",) if wall == "recorded" else ("holds", "undecided"))
    assert found.interval[0] - 5e-4 < 0 < found.interval[1] + 5e-4


@pytest.mark.parametrize(("wall", "tolerance"), [("recorded", 1e-3), ("one", 4e-3)])
@pytest.mark.parametrize("seed", range(11, 14))
def test_twenty_millimetres_are_found_and_measured(
    checked: Check, wall: Wall, tolerance: float, seed: int
) -> None:
    found = checked(wall, seed, 20.0)
    assert found.verdict == "drifted"
    assert found.offset == pytest.approx(0.020, abs=tolerance)


def test_walls_that_may_stand_anywhere_leave_a_wide_interval_with_the_truth(checked: Check) -> None:
    free, known = checked("per_image", 11, 20.0), checked("recorded", 11, 20.0)
    assert free.interval[0] < 0.020 < free.interval[1]
    assert width(free) > 5 * width(known)


def test_where_the_recorded_wall_stands_does_not_matter_if_it_is_not_believed(
    state: CalibrationState, walls: Walls
) -> None:
    few = walls(11)
    table = few.first.frames
    moved = replace(few.first, frames=replace(table, offset=table.offset + 0.3))
    believed = check_drift(state, few, "per_image")
    displaced = check_drift(state, Dataset((moved,)), "per_image")
    assert displaced.offset == pytest.approx(believed.offset, abs=1e-9)


def test_a_wall_that_bends_is_not_flat_any_more(state: CalibrationState, walls: Walls) -> None:
    few = walls(11).first
    rows = np.linspace(-1, 1, CAMERA["height"])[:, None]
    bowl = (0.03 * (rows**2 + np.linspace(-1, 1, CAMERA["width"]) ** 2)).astype(np.float32)
    found = check_drift(state, Dataset((replace(few, depth=few.depth + bowl),)), "per_image")
    assert found.verdict == "drifted"
    assert found.flatness > found.threshold


def test_the_command_says_so_and_writes_json_and_a_page(
    state: CalibrationState, walls: Walls, tmp_path: Path, program: Program
) -> None:
    few = walls(11, 20.0)
    run = tmp_path / "run"
    run.mkdir()
    save_calibration(run / "state.pt", state)
    given = ("--run", run, "--recording", few.first.path, "--wall", "recorded")
    said = program("check", *given, "--out", tmp_path / "check.json")
    found = tofcorr.check(run, few.first.path, wall="recorded")
    assert said == (0, f"{found!r}\nWritten to {tmp_path / 'check.json'}\n", "")
    written = json.loads((tmp_path / "check.json").read_text())
    assert written == found.to_mapping()
    assert written["verdict"] == "drifted"
    assert written["offset_mm"] == pytest.approx(20.0, abs=1.0)
    # A run of an older version has no reference.
    assert "takes the form" in repr(found)
    page = tmp_path / "check.html"
    said = program("check", *given, "--page", page)
    assert said == (0, f"{found!r}\nWritten to {page}\n", "")
    text = html.unescape(page.read_text(encoding="utf-8"))
    assert (fetched(text), silent(text)) == ([], 0)
    # The two lines with a limit are boxes there.
    boxes = [line for line in repr(found).splitlines() if line.endswith("limit 5 mm")]
    assert len(boxes) == 2
    for sentence in set(repr(found).splitlines()) - set(boxes):
        assert sentence in text
    assert f"<b>{1e3 * found.offset:.1f} mm</b>" in text
    assert "exists already" in program("check", *given, "--page", page).err
    assert "ends in .html" in program("check", *given, "--page", tmp_path / "check.md").err


@pytest.mark.parametrize(
    ("wall", "changed", "ends", "wider"),
    [
        # A bow of the wall hides an offset only where the wall is unknown.
        ("per_image", "bow_variance", (1e-10, 1e-6), (2, np.inf)),
        ("recorded", "bow_variance", (1e-10, 1e-6), (1, 1.2)),
        # Images that scattered less when calibrated leave a narrower interval; where the place of
        # the wall is known, the poses' errors stand for how images scatter.
        ("per_image", "scatter", (0.3, 1.0), (1.1, np.inf)),
        ("recorded", "scatter", (0.3, 1.0), (1, 1)),
        # Images that are alike leave a wider one.
        ("recorded", "persistence", (0.0, 0.5), (1.2, np.inf)),
    ],
)
def test_what_the_calibration_left_uncertain_widens_the_interval(
    checked: Check, wall: Wall, changed: str, ends: tuple[float, ...], wider: tuple[float, ...]
) -> None:
    small, large = (width(checked(wall, **{changed: one})) for one in ends)
    assert wider[0] <= large / small <= wider[1]


def test_views_that_were_not_calibrated_are_mentioned(checked: Check, reference: Reference) -> None:
    like = repr(checked())
    assert "as no calibrated one did" not in like
    assert "takes the form" not in like
    # The same calibration, if every wall had been seven times as far away.
    found = checked(views=present(reference.views) + torch.tensor([0, 0, 0, 0, 0, 0, 2.0]))
    assert found.unlike > 0.5
    assert "as no calibrated one did" in repr(found)


def test_a_wall_that_is_unknown_is_said_to_show_little(
    state: CalibrationState, reference: Reference, tmp_path: Path
) -> None:
    few = simulated_wall(tmp_path / "few", 11, FEW[:1], sensor=sensor())
    found = check_drift(state, few, "per_image", reference=reference, threshold=1e-3)
    assert found.verdict == "undecided"
    assert "tells an offset to within" in repr(found)
