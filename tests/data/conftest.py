from pathlib import Path

import pytest
from small_recordings import write_small_recording


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A whole recording with every optional part, free to be damaged."""
    return write_small_recording(tmp_path / "recording")
