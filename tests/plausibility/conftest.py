"""Clean recordings that faults are made in."""

from pathlib import Path

import diagnosed_recordings
import pytest

from benchmarks.wrong_recordings.parts import Parts
from tofcorr.data.recording import Recording
from tofcorr.options import resolve_options
from tofcorr.simulation.options import SimulatorOptions
from tofcorr.simulation.simulator import simulate


@pytest.fixture(scope="session")
def clean(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The shipped demo with 22 poses, a seed that no threshold was chosen on."""
    folder = tmp_path_factory.mktemp("clean") / "recording"
    shots = ({"target": "white", "poses": 10}, {"target": "checkerboard", "poses": 12})
    options = resolve_options(SimulatorOptions, "demo").to_mapping()
    simulate(SimulatorOptions.from_mapping(options | {"seed": 77, "shots": shots}, "demo"), folder)
    return folder


@pytest.fixture(scope="session")
def parts(clean: Path) -> Parts:
    return Parts.read(clean)


@pytest.fixture(scope="session")
def white_wall(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """Forty poses before a white wall."""
    folder = tmp_path_factory.mktemp("white") / "recording"
    shots = {"shots": [{"target": "white", "poses": 40}]}
    return diagnosed_recordings.recorded(folder, 73, changes=shots)
