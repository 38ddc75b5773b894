"""Where nothing can be written, a command says so before it does any work."""

from collections.abc import Callable, Iterator
from pathlib import Path

import click
import pytest
from running import Program

import tofcorr
from tofcorr.cli.main import COMMANDS, group
from tofcorr.errors import CalibrationDataError

_NOWHERE = "no such recording"


def _commands(of: click.Group, *names: str) -> Iterator[tuple[tuple[str, ...], click.Command]]:
    context = click.Context(of)
    for name in of.list_commands(context):
        command = of.get_command(context, name)
        assert command is not None
        if isinstance(command, click.Group):
            yield from _commands(command, *names, name)
        else:
            yield (*names, name), command


WRITING = [
    (*names, option)
    for names, command in _commands(group)
    for param in command.params
    for option in param.opts
    if option in ("--out", "--ply")
]


@pytest.mark.parametrize("words", WRITING, ids=" ".join)
def test_an_output_that_cannot_be_written_is_refused_before_anything_else(
    tmp_path: Path, program: Program, words: tuple[str, ...]
) -> None:
    """`tofcorr diagnose` found a folder in its way after minutes of work."""
    code, _, told = program(*words, tmp_path)
    assert code == 2
    assert told.startswith(f"Error: {tmp_path}: ")
    assert "exists already and is not overwritten" in told or "is a folder" in told


def test_every_command_but_two_writes() -> None:
    """`watch` serves a page, and writes a run when it is ended."""
    assert {words[0] for words in WRITING} == COMMANDS.keys() - {"configs", "watch"}


_FUNCTIONS: dict[str, Callable[[Path], object]] = {
    "train": lambda out: tofcorr.train(_NOWHERE, out=out),
    "rig": lambda out: tofcorr.rig(_NOWHERE, out=out),
    "evaluate": lambda out: tofcorr.evaluate(_NOWHERE, out=out),
    "select": lambda out: tofcorr.select(_NOWHERE, out=out),
    "diagnose": lambda out: tofcorr.diagnose(_NOWHERE, out=out),
    "inspect": lambda out: tofcorr.inspect(_NOWHERE, out=out),
}


@pytest.mark.parametrize("name", _FUNCTIONS)
def test_a_function_refuses_it_before_it_opens_a_recording(tmp_path: Path, name: str) -> None:
    out = tmp_path / "page.html"
    out.write_text("of yesterday")
    with pytest.raises(CalibrationDataError, match="exists already and is not overwritten"):
        _FUNCTIONS[name](out)
    assert out.read_text() == "of yesterday"


def test_one_folder_cannot_hold_both_recording_and_point_clouds(
    tmp_path: Path, program: Program
) -> None:
    one = str(tmp_path / "one")
    words = ["correct", "--model", _NOWHERE, "--recording", _NOWHERE, "--out", one, "--ply", one]
    assert "--out and --ply name the same folder" in program(*words).err
