"""Bad input ends in one message and exit code 2: no traceback, and nothing half-written."""

import re
from pathlib import Path

import pytest
from broken_recordings import OF_EACH_SORT
from running import Program
from small_recordings import write_small_recording

ROOT = Path(__file__).resolve().parents[2]
CONFIG = str(ROOT / "configs" / "train" / "ea.yaml")


@pytest.mark.parametrize("command", ["correct", "train"])
@pytest.mark.parametrize("message", OF_EACH_SORT)
def test_a_command_refuses_a_broken_recording(
    tmp_path: Path, program: Program, message: str, command: str
) -> None:
    model = tmp_path.parent / "corrector.ts"  # A recording is looked at before it is.
    model.write_bytes(b"")
    recording = write_small_recording(tmp_path / "recording")
    OF_EACH_SORT[message](recording)
    own = ("--model", model) if command == "correct" else ("--config", CONFIG)
    given = (*own, "--recording", recording)
    code, _, told = program(command, *given, "--out", tmp_path / "new" / "out")
    assert code == 2
    assert re.fullmatch(rf"Error: .*({message}).*\n", told)
    assert list(tmp_path.iterdir()) == [recording]
