"""What the simulator refuses leaves nothing behind."""

from collections.abc import Callable
from pathlib import Path

import pytest
from simulation.written_files import files_in

from tofcorr.errors import CalibrationDataError, ConfigError
from tofcorr.simulation.effects.build import build_effects
from tofcorr.simulation.options import SimulatorOptions
from tofcorr.simulation.plan import draw_plan
from tofcorr.simulation.simulator import seeded, simulate

Small = Callable[..., SimulatorOptions]


def test_unknown_effect_is_named_with_its_nearest(small: Small) -> None:
    with pytest.raises(ConfigError, match=r"effects\[0\]: there is no effect 'wigglin'"):
        build_effects([{"name": "wigglin"}])
    with pytest.raises(ConfigError, match=r"effects\[0\]: 'name' is missing"):
        build_effects([{"amplitude_mm": 3}])


def test_simulation_with_an_unknown_effect_leaves_nothing_behind(
    small: Small, tmp_path: Path
) -> None:
    with pytest.raises(ConfigError, match="there is no effect"):
        simulate(small(effects=[{"name": "gremlins"}]), tmp_path / "deep/r")
    assert list(tmp_path.iterdir()) == []


def test_recording_that_exists_is_not_overwritten(small: Small, tmp_path: Path) -> None:
    simulate(small(), tmp_path / "r", num_frames=1)
    before = files_in(tmp_path / "r")
    with pytest.raises(CalibrationDataError, match="exists already"):
        simulate(small(), tmp_path / "r")
    assert files_in(tmp_path / "r") == before


def test_more_frames_than_planned_are_refused(small: Small) -> None:
    options = small()
    with pytest.raises(ConfigError, match="8 frames are asked for, but the options plan 7"):
        draw_plan(options, seeded(options), num_frames=8)
