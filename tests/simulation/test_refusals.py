"""What the simulator refuses leaves nothing behind."""

from pathlib import Path
from typing import Any

import pytest
from simulation.small import files_in, small

from tofcorr.errors import CalibrationDataError, ConfigError
from tofcorr.simulation.effects.registry import build_effects
from tofcorr.simulation.simulator import simulate


def test_unknown_effect_is_named_with_its_nearest() -> None:
    with pytest.raises(ConfigError, match=r"effects\[0\]: there is no effect 'wigglin'"):
        build_effects([{"name": "wigglin"}])
    with pytest.raises(ConfigError, match=r"effects\[0\]: 'name' is missing"):
        build_effects([{"amplitude_mm": 3}])


def test_simulation_with_an_unknown_effect_leaves_nothing_behind(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="there is no effect"):
        simulate(small(effects=[{"name": "gremlins"}]), tmp_path / "deep/r")
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
    ],
    ids=["distances", "motion", "normal", "harmonics", "map"],
)
def test_options_that_contradict_themselves_are_refused(
    sections: dict[str, Any], message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        small(**sections)
