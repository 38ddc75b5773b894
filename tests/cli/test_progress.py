"""Progress bars are for people: nothing of them in a log file."""

import io
import os
import pty
import select
import subprocess
import sys
import termios
from pathlib import Path

import click
import pytest

import tofcorr
from tofcorr.cli.main import COMMANDS, group
from tofcorr.progress import log_to_stderr, stages, through


class Terminal(io.StringIO):
    """Standard error as a terminal has it."""

    def isatty(self) -> bool:
        return True


def test_at_a_terminal_a_bar_counts_and_the_stage_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = Terminal()
    monkeypatch.setattr("sys.stderr", terminal)
    assert list(through([1, 2, 3], "weighing")) == [1, 2, 3]
    assert "weighing" in terminal.getvalue()
    assert "/3" in terminal.getvalue()
    with stages("cooking", 2) as begin:
        begin("boiling")
        begin("frying")
    assert "cooking: boiling" in terminal.getvalue()
    assert "cooking: frying" in terminal.getvalue()


def test_elsewhere_nothing_is_written(monkeypatch: pytest.MonkeyPatch) -> None:
    stream = io.StringIO()
    monkeypatch.setattr("sys.stderr", stream)
    assert list(through(range(3), "weighing")) == [0, 1, 2]
    with stages("cooking", 1) as begin:
        begin("boiling")
    assert stream.getvalue() == ""


@pytest.mark.usefixtures("log_lines")
def test_log_lines_stand_in_place_of_bars(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = Terminal()
    monkeypatch.setattr("sys.stderr", terminal)
    log_to_stderr()
    with stages("cooking", 1) as begin:
        begin("boiling")
    list(through(range(3), "weighing", "egg"))
    first, second = terminal.getvalue().splitlines()
    assert first.endswith("cooking: boiling")
    assert "weighing: 3 eggs in" in second
    assert "\r" not in terminal.getvalue()


@pytest.mark.parametrize("name", [name for name in COMMANDS if name != "import"])
def test_every_command_takes_verbose(name: str) -> None:
    command = group.get_command(click.Context(group), name)
    assert command is not None
    assert [option.name for option in command.params].count("verbose") == 1


@pytest.mark.slow
@pytest.mark.parametrize("command", ["train", "check", "diagnose"])
def test_long_commands_show_progress_at_a_terminal_and_nowhere_else(
    command: str, tmp_path: Path
) -> None:
    recording, run = str(tmp_path / "wall"), str(tmp_path / "run")
    tofcorr.simulate("demo", recording)
    if command == "check":
        tofcorr.train(recording, "ea", out=run)
    arguments = {
        "train": ["--recording", recording, "--no-figures"],
        "check": ["--run", run, "--recording", recording],
        "diagnose": ["--recording", recording, "--set", "page=false"],
    }[command]
    program = [sys.executable, "-m", "tofcorr", command, *arguments]
    primary, secondary = pty.openpty()
    termios.tcsetwinsize(secondary, (24, 100))  # A terminal of no width shows no bar.
    subprocess.run([*program, "--out", str(tmp_path / "a")], stderr=secondary, check=True)
    shown = b""
    while select.select([primary], [], [], 1.0)[0]:
        shown += os.read(primary, 1 << 16)
    words = {"train": "training: fit", "check": "checking", "diagnose": "naming"}
    assert words[command] in shown.decode()
    quiet = subprocess.run([*program, "--out", tmp_path / "b"], capture_output=True, check=True)
    assert quiet.stderr == b""
