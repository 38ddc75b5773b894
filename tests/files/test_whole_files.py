"""Where a command may write, and what comes of what a killed run left there."""

import errno
import logging
import multiprocessing
import os
from pathlib import Path

import pytest

from tofcorr import files
from tofcorr.errors import CalibrationDataError, ConfigError, ExportError
from tofcorr.files import scratch_folder, staged_file, staged_folder

NAMES = ["a b", "-o", "--out", "ü ß 試.d", 'it\'s "quoted"', "*?[x]", "x" * 255, "é" * 127, "a.b.c"]
ODD = ["two\nlines", "tab\there", "\x1b[31mred", "bytes\udcff", "\u2028"]


def write_file(path: Path, text: str = "new") -> None:
    with staged_file(path) as part:
        part.write_text(text)


def write_folder(path: Path) -> None:
    with staged_folder(path) as folder:
        (folder / "content").write_text("new")


@pytest.mark.parametrize("name", NAMES)
def test_any_name_that_can_be_shown_is_written_to(tmp_path: Path, name: str) -> None:
    write_folder(tmp_path / "folders" / name)
    assert (tmp_path / "folders" / name / "content").read_text() == "new"
    write_file(tmp_path / name)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(["folders", name])


@pytest.mark.parametrize("name", ODD)
def test_a_name_that_no_message_can_show_is_refused_in_one_line(tmp_path: Path, name: str) -> None:
    for write, kind in ((write_file, ExportError), (write_folder, CalibrationDataError)):
        with pytest.raises(kind, match="the name holds a control character") as refusal:
            write(tmp_path / name)
        assert str(refusal.value).isprintable()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["x" * 256, "é" * 128])
def test_a_name_too_long_for_the_disk_is_refused_at_once(tmp_path: Path, name: str) -> None:
    with pytest.raises(CalibrationDataError, match=r"cannot be written \(File name too long"):
        write_folder(tmp_path / "new" / name)
    with pytest.raises(ExportError, match="File name too long"):
        write_file(tmp_path / name)
    assert list(tmp_path.iterdir()) == []


def test_a_folder_is_never_written_where_something_is(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to("nowhere")
    (tmp_path / "empty").mkdir()
    for path in (tmp_path / "link", tmp_path / "empty", Path("/"), Path(), Path("/dev/null")):
        with pytest.raises(CalibrationDataError, match="exists already and is not overwritten"):
            write_folder(path)


def test_a_file_is_written_through_a_symbolic_link(tmp_path: Path) -> None:
    (tmp_path / "store").mkdir()
    (tmp_path / "store" / "old").write_text("old")
    for name in ("old", "dangling"):
        link = tmp_path / name
        link.symlink_to(f"store/{name}")
        write_file(link)
        assert link.is_symlink()
        assert (tmp_path / "store" / name).read_text() == "new"
    (tmp_path / "loop").symlink_to("loop")
    with pytest.raises(ExportError, match="leads to itself"):
        write_file(tmp_path / "loop")


def test_what_is_no_file_is_not_replaced_by_one(tmp_path: Path) -> None:
    # os.replace would put a file in place of the device.
    os.mkfifo(tmp_path / "pipe")
    for path, reason in {
        tmp_path / "pipe": "is a device or a pipe",
        Path("/dev/null"): "is a device or a pipe",
        tmp_path: "is a folder",
        Path("/"): "is a folder",
        tmp_path / "none" / "file": "its folder does not exist",
        tmp_path / "pipe" / "file": "its folder does not exist",
    }.items():
        with pytest.raises(ConfigError, match=reason), staged_file(path, ConfigError) as part:
            part.write_text("new")
    assert not Path("/dev/null").is_file()


@pytest.mark.parametrize("number", [errno.EROFS, errno.EACCES, errno.ENOSPC])
def test_what_the_file_system_refuses_is_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(Path, "mkdir", refuse)
    monkeypatch.setattr(Path, "touch", refuse)
    with pytest.raises(CalibrationDataError, match=os.strerror(number)):
        write_folder(tmp_path / "folder")
    with pytest.raises(ExportError, match=os.strerror(number)):
        write_file(tmp_path / "file")
    assert list(tmp_path.iterdir()) == []


def test_a_file_that_is_not_finished_leaves_the_older_one(tmp_path: Path) -> None:
    write_file(tmp_path / "file", "older")
    with pytest.raises(ZeroDivisionError), staged_file(tmp_path / "file"):
        _ = 1 / 0
    assert [path.read_text() for path in tmp_path.iterdir()] == ["older"]


def die_while_writing(folder: Path) -> None:
    """End as a killed process does: no handler runs, the system lets go of the locks."""
    with staged_folder(folder / "run") as run, scratch_folder(), staged_file(folder / "file.yaml"):
        (run / "content").write_text("half")
        os._exit(9)


def killed(folder: Path) -> None:
    process = multiprocessing.get_context("fork").Process(target=die_while_writing, args=(folder,))
    process.start()
    process.join()
    assert process.exitcode == 9


def test_the_next_run_removes_what_a_killed_one_left_and_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "scratch").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "scratch"))
    killed(tmp_path)
    left = sorted(path.name for path in tmp_path.iterdir())
    assert len(left) == 3
    assert len(list((tmp_path / "scratch").iterdir())) == 1
    write_folder(tmp_path / "run")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["run", "scratch"]
    assert list((tmp_path / "scratch").iterdir()) == []
    assert caplog.text.count("which a killed run had left") == 3


def test_what_another_process_is_writing_stays(tmp_path: Path) -> None:
    with staged_folder(tmp_path / "one") as one, staged_file(tmp_path / "two") as two:
        two.write_text("two")
        write_folder(tmp_path / "three")
        assert one.is_dir()
        assert two.is_file()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["one", "three", "two"]


def test_a_leftover_that_cannot_be_locked_is_named_and_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    # The second as earlier versions called them.
    left = [tmp_path / files.temporary_name(), tmp_path / ".run.tofcorr-0123abcd.part"]
    others = [tmp_path / ".run.part", tmp_path / ".run.12345678.part", tmp_path / ".tofcorr"]
    for path in (*left, *others):
        path.mkdir()
    monkeypatch.setattr(files, "fcntl", None)
    caplog.set_level(logging.WARNING)
    write_file(tmp_path / "file")
    assert all(f"{path} may be what a killed run left" in caplog.text for path in left)
    assert all(path.is_dir() for path in (*left, *others))
