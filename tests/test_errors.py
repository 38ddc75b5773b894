"""What a user reads of an error is one line, whatever a file or a library put into it."""

import errno
import json
from pathlib import Path

import click
import pytest
from hypothesis import given
from hypothesis import strategies as st
from running import Program

import tofcorr
from tofcorr import errors
from tofcorr.cli.main import group
from tofcorr.errors import CalibrationDataError, TofcorrError, printable
from tofcorr.files import write_json
from tofcorr.importing.run import RefusedViewError

KINDS = [*(kind for kind in vars(errors).values() if isinstance(kind, type)), RefusedViewError]
TEXT = st.text(st.characters(codec=None), max_size=30)


def test_every_error_is_a_public_name() -> None:
    """`FrameError` and `StateError`, which calls of the package raise, were not."""
    kinds = {name for name, kind in vars(errors).items() if isinstance(kind, type)}
    assert kinds <= set(tofcorr.__all__)
    assert all(getattr(tofcorr, name) is getattr(errors, name) for name in kinds)


@given(text=TEXT, kind=st.sampled_from(KINDS))
def test_the_message_of_any_error_is_one_line(text: str, kind: type[TofcorrError]) -> None:
    message = str(kind(f"scene.json: got {text}."))
    assert len(message.splitlines()) == 1
    message.encode("utf-8")
    assert printable(message) == message


@given(text=st.text(st.characters(exclude_categories=["C", "Z"]), max_size=30))
def test_text_that_can_be_shown_stays_as_it_is(text: str) -> None:
    assert str(TofcorrError(text)) == text


def test_control_characters_are_shown_as_python_writes_them() -> None:
    assert str(TofcorrError("a\nb\t\x1b[31m\u2028\udcff")) == r"a\nb\t\x1b[31m\u2028\udcff"


def test_the_terminal_shows_one_line(monkeypatch: pytest.MonkeyPatch, program: Program) -> None:
    full = OSError(errno.ENOSPC, "No space left on device", "report.json")
    for error, said in (
        (CalibrationDataError("scene.json: got a\nb."), "scene.json: got a\\nb."),
        (full, "report.json: No space left on device."),
    ):

        @click.command()
        def refuse(error: Exception = error) -> None:
            raise error

        monkeypatch.setattr(group, "get_command", lambda context, name, one=refuse: one)
        assert program("train") == (2, "", f"Error: {said}\n")


def test_json_holds_null_for_what_could_not_be_measured(tmp_path: Path) -> None:
    file = tmp_path / "import.json"
    write_json(file, {"lag": {"correlation": float("nan")}, "rms": [1.0, float("inf")]})
    assert json.loads(file.read_text()) == {"lag": {"correlation": None}, "rms": [1.0, None]}
