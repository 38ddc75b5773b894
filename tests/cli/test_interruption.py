"""An interruption ends the program, whenever it comes, and leaves nothing half-written."""

import shutil
import signal
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click
import pytest
from running import Program, Said

from tofcorr.cli.main import group
from tofcorr.files import remove_begun, scratch_folder, staged_file, staged_folder

Run = Callable[[Callable[[], object]], Said]


@pytest.fixture
def run(program: Program, monkeypatch: pytest.MonkeyPatch) -> Run:
    """The program with a command of the test's own."""

    def call(command: Callable[[], object]) -> Said:
        monkeypatch.setattr(group, "get_command", lambda context, name: click.command()(command))
        monkeypatch.setattr(threading, "excepthook", threading.excepthook)
        return program("train")

    return call


@pytest.mark.parametrize("told_to_end", [True, False])
def test_only_an_interruption_excuses_the_error_of_a_library_that_is_being_imported(
    told_to_end: bool, run: Run
) -> None:
    def work() -> None:
        try:
            if told_to_end:
                signal.raise_signal(signal.SIGTERM)
        except KeyboardInterrupt:
            pass
        raise ImportError("initialization failed")  # As modules in C++ do.

    if told_to_end:
        code, _, told = run(work)
        assert (code, told.strip()) == (130, "Interrupted; nothing half-written was left.")
    else:
        with pytest.raises(ImportError):
            run(work)


def test_what_a_second_interruption_kept_from_being_removed_is_removed_at_the_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, run: Run
) -> None:
    remove = shutil.rmtree

    def stop(*_: object, **__: object) -> None:
        monkeypatch.setattr(shutil, "rmtree", remove)
        raise KeyboardInterrupt

    def work() -> None:
        with staged_folder(tmp_path / "new" / "run") as folder:
            (folder / "half").write_text("half")
            monkeypatch.setattr(shutil, "rmtree", stop)
            raise KeyboardInterrupt

    said = run(work)
    assert said.code == 130
    assert said.err.strip() == "Interrupted; nothing half-written was left."
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("make", [staged_folder, staged_file, lambda _: scratch_folder()])
def test_what_was_begun_before_its_block_is_removed(
    make: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "temporary"))
    (tmp_path / "temporary").mkdir()
    block = make(tmp_path / "run")
    assert block.__enter__().exists()
    remove_begun()
    assert list(tmp_path.rglob("*")) == [tmp_path / "temporary"]


def test_what_is_done_is_not_removed(tmp_path: Path) -> None:
    with staged_folder(tmp_path / "run") as folder:
        (folder / "whole").write_text("whole")
    with staged_file(tmp_path / "file") as part:
        part.write_text("whole")
    remove_begun()
    assert (tmp_path / "run" / "whole").read_text() == (tmp_path / "file").read_text() == "whole"
