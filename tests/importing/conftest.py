"""Recorded once for all tests of the doors."""

import pytest
from importing.posed_scene import Drive, Recorded


@pytest.fixture(scope="session")
def drive() -> Recorded:
    """40 stops, and the moves between them, at some 7 images a second."""
    return Drive(width=48, height=36).record()


@pytest.fixture(scope="session")
def at_stops(drive: Recorded) -> Recorded:
    """One image of each stop."""
    return drive.one_a_stop()
