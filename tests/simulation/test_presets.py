"""The configurations that ship."""

from pathlib import Path

import numpy as np
import pytest
from running import Program

import tofcorr
from tofcorr.data.recording import Recording
from tofcorr.geometry.rays import unambiguous_range
from tofcorr.simulation.simulator import simulate

FOLDER = Path(__file__).resolve().parents[2] / "configs" / "simulate"
PRESETS = sorted(path.stem for path in FOLDER.glob("*.yaml"))


@pytest.mark.parametrize("name", PRESETS)
def test_preset_loads_and_simulates_a_frame(name: str, tmp_path: Path) -> None:
    recording = tofcorr.simulate(name, tmp_path / "r", num_frames=1)
    assert (recording.path, recording.num_frames) == (tmp_path / "r", 1)
    assert np.isfinite(recording.depth).all()


SETS = {
    "set1": {"checkerboard": 62},
    "set2": {"white": 30},
    "set3": {"white": 20, "checkerboard": 22},
}


@pytest.mark.parametrize("name", SETS)
def test_paper_set_has_its_images_below_two_metres(name: str, tmp_path: Path) -> None:
    recording, targets = simulate(name, tmp_path / "r"), SETS[name]
    assert recording.depth.shape == (sum(targets.values()), 50, 64)
    assert recording.modulation_frequency == 20.0e6
    names, counts = np.unique(recording.frames.target, return_counts=True)
    assert dict(zip(names.tolist(), counts.tolist(), strict=True)) == targets
    true = np.load(tmp_path / "r/truth/radial_distance.npy")
    assert true.max() < 2.0
    # As large as the paper's errors before calibration.
    assert 0.025 < np.abs(recording.depth - true).mean() < 0.055


def test_repeats_hold_two_poses_of_ten_frames(tmp_path: Path) -> None:
    recording = simulate("repeats", tmp_path / "r")
    _, counts = np.unique(recording.require("pose_id", "this test"), return_counts=True)
    assert sorted(counts.tolist()) == [1] * 40 + [10, 10]


def test_long_range_shows_whole_periods_of_the_circular_error(tmp_path: Path) -> None:
    recording = simulate("long_range", tmp_path / "r", noise=False)
    true = np.load(tmp_path / "r/truth/radial_distance.npy").ravel()
    error = recording.depth.ravel() - true
    turn = 2 * np.pi * true / (unambiguous_range(20.0e6) / 4)
    columns = np.stack([np.ones_like(true), true, np.sin(turn), np.cos(turn)], axis=1)
    strength = np.linalg.lstsq(columns, error, rcond=None)[0]
    assert np.ptp(true) > 3 * unambiguous_range(20.0e6) / 4
    assert np.hypot(*strength[2:]) > 0.015


def test_command_writes_a_recording_and_says_where(tmp_path: Path, program: Program) -> None:
    given = ("--config", FOLDER / "demo.yaml", "--out", tmp_path / "r", "--frames", 2, "--seed", 9)
    assert str(tmp_path / "r") in program("simulate", *given).out
    assert Recording.open(tmp_path / "r").num_frames == 2
    assert "seed: 9" in (tmp_path / "r/truth/truth.yaml").read_text()
