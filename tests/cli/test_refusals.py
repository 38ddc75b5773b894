"""Bad input ends in one message and exit code 2: no traceback, and nothing half-written."""

import os
import re
import signal
import subprocess
import sys
import time
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


WRITE_FOR_EVER = """
import signal
import sys
import click
import numpy as np
from small_recordings import CAMERA, frame_rows
from tofcorr.cli import main
from tofcorr.data.writing import RecordingWriter

# Shells start programs in the background with this signal ignored.
signal.signal(signal.SIGINT, signal.default_int_handler)

@click.command()
def for_ever():
    row = frame_rows(np.random.default_rng(0))[0]
    with RecordingWriter(out, camera=CAMERA, depth_kind="z") as writer:
        while True:
            writer.append(np.ones((5, 7)), row=row)

out = sys.argv[1]
sys.argv = ["tofcorr", "simulate"]
main.group.get_command = lambda context, name: for_ever
main.main()
"""


@pytest.mark.parametrize("stop", [signal.SIGINT, signal.SIGTERM])
def test_a_program_stopped_while_writing_leaves_nothing(
    tmp_path: Path, stop: signal.Signals
) -> None:
    writing = [sys.executable, "-c", WRITE_FOR_EVER, str(tmp_path / "new" / "recording")]
    environment = os.environ | {"PYTHONPATH": str(ROOT / "tests")}
    with subprocess.Popen(writing, stderr=subprocess.PIPE, text=True, env=environment) as process:
        try:
            patience = time.monotonic() + 60
            while not list(tmp_path.rglob("depth.npy")) and time.monotonic() < patience:
                time.sleep(0.05)
            assert list(tmp_path.rglob("depth.npy"))
            process.send_signal(stop)
            _, told = process.communicate(timeout=60)
        finally:
            process.kill()
    assert process.returncode == 130
    assert told.strip() == "Interrupted; nothing half-written was left."
    assert list(tmp_path.iterdir()) == []
