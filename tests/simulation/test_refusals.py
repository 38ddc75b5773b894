"""What the simulator refuses leaves nothing behind."""

from pathlib import Path
from typing import Any

import pytest
from simulation.small import files_in, small

from tofcorr.errors import CalibrationDataError, ConfigError
from tofcorr.simulation.simulator import simulate


@pytest.mark.parametrize(
    ("sections", "message"),
    [
        ({"effects": [{"name": "wigglin"}]}, r"\[0\]: there is no effect 'wigglin'. Did you mean"),
        (
            {"effects": [{"name": "gremlins"}]},
            r"no effect 'gremlins'. Known effects: ambient_light",
        ),
        ({"effects": [{"amplitude_mm": 3}]}, r"effects\[0\]: 'name' is missing"),
        ({"shots": [{"target": "grey"}]}, r"no target 'grey' \(known: white, checkerboard\)"),
        (
            {"robot": {"distance_m": [3.0, 4.0], "farthest_pixel_m": 2.0}},
            "no pose found where the wall fills the image",
        ),
    ],
    ids=["near miss", "unknown effect", "no name", "target", "pose"],
)
def test_what_cannot_be_simulated_leaves_nothing_behind(
    sections: dict[str, Any], message: str, tmp_path: Path
) -> None:
    with pytest.raises(ConfigError, match=message):
        simulate(small(**sections), tmp_path / "deep/r")
    assert list(tmp_path.iterdir()) == []


def test_recording_that_exists_is_not_overwritten(tmp_path: Path) -> None:
    simulate(small(), tmp_path / "r", num_frames=1)
    before = files_in(tmp_path / "r")
    with pytest.raises(CalibrationDataError, match="exists already"):
        simulate(small(), tmp_path / "r")
    assert files_in(tmp_path / "r") == before


def test_more_frames_than_planned_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="8 frames are asked for, but the options plan 7"):
        simulate(small(), tmp_path / "r", num_frames=8)


@pytest.mark.parametrize(
    ("sections", "message"),
    [
        ({"robot": {"distance_m": [2.0, 1.0]}}, "smallest distance 2 exceeds the largest 1"),
        ({"robot": {"motion": "continuous", "repeat_poses": 2}}, "allows neither repeat_poses"),
        ({"scene": {"plane": {"normal": [0.0, 0.0, 2.0]}}}, "length 1, its length is 2"),
        (
            {"sensor": {"harmonics": [{"order": 3, "share": 0.1}, {"order": 3, "share": 0.2}]}},
            r"each order may appear once only, got \[3, 3\]",
        ),
        (
            {"sensor": {"delays": {"measured": {"pixel": {"values_m": [[0.0, 0.0], [0.0]]}}}}},
            "all rows must have the same length",
        ),
        (
            {"sensor": {"delays": {"measured": {"distance": {"knots": [0, 1], "values_m": [0]}}}}},
            "2 knots but 1 values_m",
        ),
        (
            {
                "sensor": {
                    "delays": {"measured": {"distance": {"knots": [1, 0], "values_m": [0, 1]}}}
                }
            },
            "the knots must increase",
        ),
    ],
    ids=["distances", "motion", "normal", "harmonics", "map", "knots", "order of knots"],
)
def test_options_that_contradict_themselves_are_refused(
    sections: dict[str, Any], message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        small(**sections)
