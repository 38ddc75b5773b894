"""A camera that reads as it did is not accused, one that does not is found out."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from click.testing import CliRunner
from drift.few_walls import FEW, Walls, sensor
from simulated_walls import CAMERA, simulated_wall

import tofcorr
from tofcorr.cli.main import group as cli
from tofcorr.correction.state import CalibrationState, save_calibration
from tofcorr.data.recording import Recording
from tofcorr.drift.check import check_drift
from tofcorr.drift.offset import Wall
from tofcorr.fit.reference import Reference
from tofcorr.pixels.dataset import Dataset


@pytest.mark.parametrize("wall", ["recorded", "one", "per_image"])
def test_a_camera_that_has_not_drifted_is_never_said_to_have(
    state: CalibrationState, reference: Reference, wall: Wall, walls: Walls
) -> None:
    for seed in range(11, 15):
        few = walls(seed)
        found = check_drift(state, few, wall, reference=reference)
        assert found.verdict != "drifted"
        assert found.interval[0] - 5e-4 < 0 < found.interval[1] + 5e-4
        if wall == "recorded":
            assert found.verdict == "holds"


@pytest.mark.parametrize(("wall", "tolerance"), [("recorded", 1e-3), ("one", 4e-3)])
def test_twenty_millimetres_are_found_and_measured(
    state: CalibrationState, reference: Reference, wall: Wall, tolerance: float, walls: Walls
) -> None:
    for seed in range(11, 14):
        few = walls(seed, 20.0)
        found = check_drift(state, few, wall, reference=reference)
        assert found.verdict == "drifted"
        assert found.offset == pytest.approx(0.020, abs=tolerance)


def test_walls_that_may_stand_anywhere_leave_a_wide_interval_that_holds_the_truth(
    state: CalibrationState, reference: Reference, walls: Walls
) -> None:
    few = walls(11, 20.0)
    free, known = (
        check_drift(state, few, wall, reference=reference) for wall in ("per_image", "recorded")
    )
    assert free.interval[0] < 0.020 < free.interval[1]
    widths = [found.interval[1] - found.interval[0] for found in (free, known)]
    assert widths[0] > 5 * widths[1]


def test_where_the_recorded_wall_stands_does_not_matter_if_it_is_not_believed(
    state: CalibrationState, walls: Walls
) -> None:
    few = walls(11)
    table = few.first.frames
    moved = replace(few.first, frames=replace(table, offset=table.offset + 0.3))
    believed = check_drift(state, few, "per_image")
    displaced = check_drift(state, Dataset((moved,)), "per_image")
    assert displaced.offset == pytest.approx(believed.offset, abs=1e-9)


def test_a_wall_that_bends_is_not_flat_any_more(state: CalibrationState, tmp_path: Path) -> None:
    few = simulated_wall(tmp_path / "few", 11, FEW, sensor=sensor())
    rows = np.linspace(-1, 1, CAMERA["height"])[:, None]
    bowl = (0.03 * (rows**2 + np.linspace(-1, 1, CAMERA["width"]) ** 2)).astype(np.float32)
    depth = np.load(few.first.path / "depth.npy")
    np.save(few.first.path / "depth.npy", depth + bowl)
    found = check_drift(state, Dataset((Recording.open(few.first.path),)), "per_image")
    assert found.verdict == "drifted"
    assert found.flatness > found.threshold


def test_the_command_says_so_and_writes_json(
    state: CalibrationState, walls: Walls, tmp_path: Path
) -> None:
    few = walls(11, 20.0)
    run = tmp_path / "run"
    run.mkdir()
    save_calibration(run / "state.pt", state)
    arguments = ["check", "--run", str(run), "--recording", str(few.first.path)]
    arguments += ["--wall", "recorded", "--out", str(tmp_path / "check.json")]
    result = CliRunner().invoke(cli, arguments, catch_exceptions=False)
    assert result.exit_code == 0
    assert "drifted" in result.output
    found = tofcorr.check(run, few.first.path, wall="recorded")
    assert result.output == f"{found!r}\n"
    written = json.loads((tmp_path / "check.json").read_text())
    assert written == found.to_mapping()
    assert written["verdict"] == "drifted"
    assert written["offset_mm"] == pytest.approx(20.0, abs=1.0)
    assert len(found.plot_images().axes) == 2


def test_with_known_walls_the_offset_is_the_weighted_mean_of_those_of_the_images(
    state: CalibrationState, walls: Walls
) -> None:
    few = walls(11, 20.0)
    found = check_drift(state, few, "recorded")
    offsets = [image.offset for image in found.images]
    assert min(offsets) < found.offset < max(offsets)
    assert found.offset == pytest.approx(np.mean(offsets), abs=5e-4)


def test_without_a_reference_the_result_says_that_the_form_is_taken_as_right(
    state: CalibrationState, reference: Reference, walls: Walls
) -> None:
    few = walls(11)
    assert "takes the form" in repr(check_drift(state, few))
    assert "takes the form" not in repr(check_drift(state, few, reference=reference))


def test_a_bow_of_the_wall_hides_an_offset_only_where_the_wall_is_unknown(
    state: CalibrationState, reference: Reference, walls: Walls
) -> None:
    few = walls(11)

    def width(wall: Wall, bow: float) -> float:
        known = replace(reference, bow_variance=bow**2)
        low, high = check_drift(state, few, wall, reference=known).interval
        return high - low

    assert width("per_image", 1e-3) > 2 * width("per_image", 1e-5)
    assert width("recorded", 1e-3) < 1.2 * width("recorded", 1e-5)


def test_images_that_scattered_less_when_calibrated_leave_a_narrower_interval(
    state: CalibrationState, reference: Reference, walls: Walls
) -> None:
    few = walls(11)

    def width(wall: Wall, scatter: float) -> float:
        known = replace(reference, scatter=scatter)
        low, high = check_drift(state, few, wall, reference=known).interval
        return high - low

    assert width("per_image", 0.3) < 0.9 * width("per_image", 1.0)
    # Where the place of the wall is known, the poses' errors stand for how images scatter.
    assert width("recorded", 0.3) == width("recorded", 1.0)


def test_views_that_were_not_calibrated_are_mentioned(
    state: CalibrationState, reference: Reference, walls: Walls
) -> None:
    few = walls(11)
    assert reference.views is not None
    assert "as no calibrated one did" not in repr(check_drift(state, few, reference=reference))
    # The same calibration, if every wall had been seven times as far away.
    farther = reference.views + torch.tensor([0, 0, 0, 0, 0, 0, 2.0])
    found = check_drift(state, few, reference=replace(reference, views=farther))
    assert found.unlike > 0.5
    assert "as no calibrated one did" in repr(found)


def test_images_that_are_alike_leave_a_wider_interval(
    state: CalibrationState, reference: Reference, walls: Walls
) -> None:
    few = walls(11)
    widths = []
    for persistence in (0.0, 0.5):
        known = replace(reference, persistence=persistence)
        low, high = check_drift(state, few, "recorded", reference=known).interval
        widths.append(high - low)
    assert widths[1] > 1.2 * widths[0]


def test_a_wall_that_is_unknown_is_said_to_show_little(
    state: CalibrationState, reference: Reference, tmp_path: Path
) -> None:
    few = simulated_wall(tmp_path / "few", 11, FEW[:1], sensor=sensor())
    found = check_drift(state, few, "per_image", reference=reference, threshold=1e-3)
    assert found.verdict == "undecided"
    assert "shows an offset only by the bow" in repr(found)
