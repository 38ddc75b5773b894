"""Recorded once for all tests of the doors."""

import pytest
from importing.frames.imported import Imported, import_png
from importing.posed_scene import Drive, Recorded

SMALL = Drive(stops=20, width=32, height=24, rate=5.0)
FULL = Drive(width=48, height=36)
"""40 stops, and the moves between them, at some 7 images a second."""


@pytest.fixture(
    scope="session",
    params=[
        pytest.param(SMALL, id="small"),
        pytest.param(FULL, id="full", marks=pytest.mark.slow),
    ],
)
def drive(request: pytest.FixtureRequest) -> Recorded:
    """Stops, and the moves between them: a few for every run, all of them for the slow one."""
    return request.param.record()


@pytest.fixture(scope="session")
def at_stops(drive: Recorded) -> Recorded:
    """One image of each stop."""
    return drive.one_a_stop()


@pytest.fixture(scope="session")
def from_files(at_stops: Recorded, tmp_path_factory: pytest.TempPathFactory) -> Imported:
    """The images of the stops and the poses, imported from PNG and TUM files."""
    return import_png(at_stops, tmp_path_factory.mktemp("from_files"))
