"""Files and folders that appear whole or not at all, and what a killed run leaves of them.

What is being written has a temporary name that is known again, is locked while in use, and is
removed however its block ends. An archive carries a digest: a change of any byte is noticed.
"""

import errno
import io
import json
import logging
import lzma
import os
import re
import shutil
import stat
import tempfile
import uuid
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from hashlib import sha256
from pathlib import Path
from pickle import UnpicklingError
from tokenize import TokenError
from typing import Any, BinaryIO

import click

from tofcorr.errors import CalibrationDataError, ExportError, Kind, is_control

try:
    import fcntl
except ImportError:  # Not on Windows: leftovers are then named, and never removed.
    fcntl = None

_LOG = logging.getLogger("tofcorr")
_OURS = re.compile(
    r"\.(?:.+\.)?tofcorr-[0-9a-f]{8}\.part[^/]*|tofcorr-scratch-[0-9a-f]{8}", re.DOTALL
)
_OfPath = Callable[[Path], object]
_BEGUN: dict[Path, _OfPath] = {}
"""How to remove each file and folder that this process has begun, in the order of their making."""


@contextmanager
def staged_file(path: Path | str, kind: Kind = ExportError) -> Iterator[Path]:
    """Yield a temporary file beside `path`; it is renamed to `path` if the block succeeds.

    On any exception the temporary file is removed, and an older file at `path` is kept. A symbolic
    link at `path` stays; what it points to is replaced. Temporary files of killed runs in the same
    folder are removed.

    Args:
        path: The file to write.
        kind: The error to raise.

    Raises:
        TofcorrError: Of kind `kind`: the folder does not exist, or the file cannot be written.
    """
    target = file_to_replace(Path(path), kind)
    remove_leftovers(target.parent)
    part = target.with_name(temporary_name(target.suffix))
    with writing_to(path, kind), _temporary(part, lambda: part.touch(exist_ok=False)):
        yield part
        part.replace(target)


def write_text(path: Path | str, text: str, kind: Kind = ExportError) -> None:
    """Write a text, whole or not at all; an older file is replaced. It raises as `staged_file`."""
    with staged_file(path, kind) as part:
        part.write_text(text, encoding="utf-8")


def write_json(path: Path, values: Mapping[str, Any], kind: Kind = CalibrationDataError) -> None:
    """Write plain values as JSON, whole or not at all; an older file is replaced.

    A number that could not be measured (NaN, infinity) is null.
    """
    from pydantic import TypeAdapter  # Slow to import.

    with staged_file(path, kind) as part:
        part.write_bytes(TypeAdapter(dict[str, Any]).dump_json(dict(values), indent=1) + b"\n")


@contextmanager
def scratch_folder() -> Iterator[Path]:
    """Yield an empty folder among the system's temporary files; it is removed with the block.

    Those that killed runs left are removed first.

    Raises:
        OSError: It cannot be made.
    """
    parent = Path(tempfile.gettempdir())
    remove_leftovers(parent)
    folder = parent / f"tofcorr-scratch-{uuid.uuid4().hex[:8]}"
    with _temporary(folder, lambda: folder.mkdir(mode=0o700)):
        yield folder


@contextmanager
def staged_folder(path: Path | str) -> Iterator[Path]:
    """Yield a temporary folder beside `path`; it is renamed to `path` if the block succeeds.

    On any exception, Ctrl-C included, the temporary folder is removed, together with the parent
    folders that were made for it. Temporary folders that killed runs left beside it are removed.

    Args:
        path: The folder to write; nothing may be there yet.

    Raises:
        CalibrationDataError: Something is at `path` already, or it cannot be written.
    """
    refuse_existing(Path(path))
    # absolute() instead of resolve(): a symbolic link in the path is kept.
    target = Path(path).absolute()
    folder = target.parent / temporary_name(_sign(target))
    with ExitStack() as made:
        with writing_to(path):
            made.enter_context(new_folders(target.parent))
            remove_leftovers(target.parent)
            # The file system refuses a name that it cannot hold before any work is done.
            with suppress(FileNotFoundError):
                os.lstat(target)
            made.enter_context(_temporary(folder, folder.mkdir))
        yield folder
        with writing_to(path):
            if os.path.lexists(target):
                raise FileExistsError(0, "something appeared there in the meantime")
            folder.rename(target)


def being_written(path: Path, holds: str) -> Path | None:
    """Return the temporary folder that a running `staged_folder` will rename to `path`.

    Args:
        path: The folder to come.
        holds: A file that the temporary folder must hold already.

    Returns:
        The folder; None: no program is writing it, or that file is not there yet.
    """
    target = path.absolute()
    for file in target.parent.glob(f".tofcorr-*.part{_sign(target)}/{holds}"):
        with suppress(OSError):
            try:
                with _locked(file.parent) as known:
                    if known:
                        continue  # A killed run has left it.
            except FileExistsError:
                pass
            return file.parent
    return None


def _sign(target: Path) -> str:
    """Return what the temporary name of a folder ends with: a digest of the final name."""
    return f"-{sha256(os.fsencode(target.name)).hexdigest()[:8]}"


@contextmanager
def new_folders(path: Path) -> Iterator[None]:
    """Make a folder and those above it; what is still empty after the block is removed."""
    with ExitStack() as made:
        missing = [one for one in (path, *path.parents) if not one.exists()]
        for folder in reversed(missing):
            made.enter_context(_begun(folder, folder.mkdir, Path.rmdir))
        yield


@contextmanager
def writing_to(path: Path | str, kind: Kind = CalibrationDataError) -> Iterator[None]:
    """Say in one sentence, as an error of kind `kind`, why `path` cannot be written."""
    try:
        yield
    except OSError as error:
        raise kind(f"{path}: cannot be written ({error.strerror or error}).") from None


@contextmanager
def reading(path: Path | str, kind: Kind = CalibrationDataError) -> Iterator[None]:
    """Say in one sentence, as an error of kind `kind`, why `path` cannot be read."""
    try:
        yield
    except FileNotFoundError:
        raise kind(f"{path}: there is no such file.") from None
    except OSError as error:
        raise kind(f"{path}: cannot be read ({error.strerror or error}).") from None


def remove_begun() -> None:
    """Remove what an interruption kept from being removed.

    Python may raise `KeyboardInterrupt` between any two steps: before a block has begun that would
    tidy up, or while it does so. The program calls this when it has been stopped.
    """
    for path, undo in reversed(list(_BEGUN.items())):
        with suppress(OSError):
            undo(path)
        _BEGUN.pop(path, None)


def remove_leftovers(folder: Path) -> None:
    """Remove what killed runs left in a folder and among the system's temporary files; say so.

    What another process is writing is locked, and stays. What cannot be removed is named.
    """
    for path in [*_leftovers(folder), *_leftovers(Path(tempfile.gettempdir()))]:
        said = "%s may be what a killed run left; if so, remove it."
        try:
            with _locked(path) as known:
                if known:
                    shutil.rmtree(path) if path.is_dir() else path.unlink()
                    said = "Removed %s, which a killed run had left."
        except (FileExistsError, FileNotFoundError):
            continue  # In use, or removed by another process in the same moment.
        except OSError:
            pass
        _LOG.warning(said, path)


def temporary_name(suffix: str = "") -> str:
    """Return a hidden name, never used before, that ends as the final one does.

    torch calls the folder inside an archive after its file: plain names serve all programs.
    """
    return f".tofcorr-{uuid.uuid4().hex[:8]}.part{suffix if suffix.isascii() else ''}"


def refuse_existing(path: Path) -> None:
    """Refuse a name at which something is, or which cannot be shown.

    Raises:
        CalibrationDataError: A file, a folder or a symbolic link is there, whatever it points to.
    """
    _refuse_name(path, CalibrationDataError)
    if os.path.lexists(path):
        said = "exists already and is not overwritten; remove it or choose another name"
        raise CalibrationDataError(f"{path}: {said}.")


def file_to_replace(path: Path, kind: Kind) -> Path:
    """Return the file that a name means: a symbolic link stands for what it points to.

    Args:
        path: Where a file is to be written; an older file there may be replaced.
        kind: The error to raise.

    Raises:
        TofcorrError: The name cannot be shown, its folder does not exist, or a folder, a device or
            a pipe is there.
    """
    _refuse_name(path, kind)
    with writing_to(path, kind):  # For example a name too long for the file system.
        target = Path(os.path.realpath(path, strict=False))
        if path.is_symlink() and target.is_symlink():
            raise kind(f"{path}: is a symbolic link that leads to itself; remove it.")
        if not target.parent.is_dir():
            raise kind(f"{path}: its folder does not exist; make it first.")
        if target.is_dir():
            raise kind(f"{path}: is a folder; give the name of a file.")
        if target.exists() and not target.is_file():
            raise kind(f"{path}: is a device or a pipe, not a file; give the name of a file.")
    return target


def file_in_new_folder(path: Path) -> None:
    """Refuse the name of a file as `file_to_replace`, unless it is to stand in a new folder."""
    if path.parent.exists():
        file_to_replace(path, ExportError)


def _refuse_name(path: Path, kind: Kind) -> None:
    """Refuse the name of an output that messages, logs and YAML cannot show."""
    if any(map(is_control, str(path))):
        said = "the name holds a control character, or is not text; choose another one"
        raise kind(f"{path}: {said}.")


@contextmanager
def _begun(path: Path, make: Callable[[], object], undo: _OfPath) -> Iterator[None]:
    """Make something, and undo it after the block, or when the program is stopped."""
    _BEGUN[path] = undo
    try:
        make()
        yield
    finally:
        with suppress(OSError):  # A parent folder is no longer empty.
            undo(path)
            _BEGUN.pop(path, None)


@contextmanager
def _temporary(path: Path, make: Callable[[], object]) -> Iterator[None]:
    """Make a temporary file or folder, locked for the length of the block and removed after it."""
    with _begun(path, make, _remove), _locked(path):
        yield


@contextmanager
def _locked(path: Path) -> Iterator[bool]:
    """Mark a temporary file or folder as in use for the length of the block.

    The operating system lets go of the lock when the process ends, however it ends.

    Yields:
        Whether the file system knows locks.

    Raises:
        FileExistsError: Another process holds the lock, or removed `path` in the same moment.
        OSError: `path` cannot be opened.
    """
    if fcntl is None:
        yield False
        return
    descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW)
    known = own = True
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            own = os.path.samestat(os.fstat(descriptor), os.lstat(path))
        except (BlockingIOError, FileNotFoundError):
            own = False
        except OSError:
            known = False
        if not own:
            raise FileExistsError(0, "another process removed a temporary file; try again")
        yield known
    finally:
        os.close(descriptor)


def _leftovers(folder: Path) -> Iterator[Path]:
    """Yield what killed runs of this user left in a folder, which other users may share."""
    with suppress(OSError):
        # Names alone: folders of thousands of files are looked through for every file written.
        found = [one.name for one in os.scandir(folder) if _OURS.fullmatch(one.name)]
        for path in [folder / name for name in sorted(found)]:
            with suppress(OSError):
                own = not hasattr(os, "getuid") or path.lstat().st_uid == os.getuid()
                if own and not path.is_symlink():
                    yield path


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    with suppress(OSError):
        path.unlink()


_RECORD = "extra/tofcorr_seal"

UNREADABLE = (
    *(OSError, ValueError, LookupError, TypeError, AttributeError, EOFError, RuntimeError),
    *(SyntaxError, TokenError, MemoryError, ArithmeticError, UnpicklingError),
    *(zipfile.BadZipFile, zlib.error, lzma.LZMAError),
)
"""What NumPy, torch, zipfile, and the parsers of their headers raise on damaged bytes."""

# Attribute of a folder in a zip archive, as DOS had it. torch takes what is marked so for empty and
# leaves the memory of its numbers as it was; zipfile reads it.
_FOLDER = 0x10

MOST_BYTES = 500_000_000
"""Most bytes of a file that is read whole, and of what an archive unpacks to. Chosen: a small
archive can be made to unpack to any size; a table for a camera of 16 megapixels takes 268 MB."""


def open_regular(path: Path | str, most_bytes: float = MOST_BYTES) -> BinaryIO:
    """Open a file to be read, unless it might never end.

    A pipe waits until somebody writes to it, and a device such as /dev/zero has no end.

    Args:
        path: The file, or a link to it.
        most_bytes: How large it may be.

    Raises:
        OSError: There is no such file, it is a pipe, a device or a folder, or it is larger.
    """

    def opened(name: str, flags: int) -> int:
        return os.open(name, flags | getattr(os, "O_NONBLOCK", 0))

    file = open(path, "rb", opener=opened)  # noqa: SIM115 - the caller closes it.
    status = os.fstat(file.fileno())
    regular = stat.S_ISREG(status.st_mode)
    if regular and status.st_size <= most_bytes:
        return file
    file.close()
    larger = f"it is larger than {most_bytes / 1e6:.0f} MB"
    raise OSError(errno.EINVAL, larger if regular else "it is no regular file")


def sealed(content: io.BytesIO) -> bytes:
    """Return a zip archive, such as torch.save and torch.jit.save write, with its digest added.

    Programs that do not know the added record ignore it. An archive is built in memory because
    torch's own writer ends the whole process where a disk is full.
    """
    with zipfile.ZipFile(content, "a") as archive:
        root = archive.namelist()[0].partition("/")[0]
        text = json.dumps({"sha256": _digest(archive)})
        # Of the earliest date that zip knows: the same content gives the same bytes at any time.
        archive.writestr(zipfile.ZipInfo(f"{root}/{_RECORD}"), text)
    return content.getvalue()


def refuse_damaged(path: Path, what: str, content: bytes | None = None) -> None:
    """Refuse an archive whose content is not what was written.

    Every record is compared with its own checksum. An archive with a seal is also compared with
    that; files of older versions have none.

    Args:
        path: The file.
        what: What it should be, for the message.
        content: Of the archive, if it stands inside the file.

    Raises:
        CalibrationDataError: It is damaged, or was changed after it was written.
    """
    try:
        with (
            open_regular(path) if content is None else io.BytesIO(content) as file,
            zipfile.ZipFile(file) as archive,
        ):
            refuse_bomb(archive)
            sealed = [name for name in archive.namelist() if name.endswith(_RECORD)]
            found = _digest(archive)
            stored = json.loads(archive.read(sealed[0]))["sha256"] if sealed else found
    except FileNotFoundError:
        raise CalibrationDataError(f"{path}: there is no such file; expected {what}.") from None
    except IsADirectoryError:
        raise CalibrationDataError(f"{path}: is a folder; expected {what}, a file.") from None
    except OSError as error:
        why = error.strerror or error
        raise CalibrationDataError(f"{path}: cannot be read ({why}); expected {what}.") from None
    except UNREADABLE:
        if not zipfile.is_zipfile(path if content is None else io.BytesIO(content)):
            raise CalibrationDataError(f"{path}: is not {what}, or is cut short.") from None
        raise CalibrationDataError(f"{path}: is damaged; expected {what}.") from None
    if stored != found or len(sealed) > 1:
        raise CalibrationDataError(f"{path}: was changed after it was written; expected {what}.")


def refuse_bomb(archive: zipfile.ZipFile) -> None:
    """Raise ValueError where an archive unpacks to more than any calibration holds."""
    if sum(entry.file_size for entry in archive.infolist()) > MOST_BYTES:
        raise ValueError("it unpacks to too much")


def _digest(archive: zipfile.ZipFile) -> str:
    """Return the digest of all records but the seal; reading compares their checksums."""
    digest = sha256()
    if any(entry.external_attr & _FOLDER for entry in archive.infolist()):
        raise ValueError("a record is marked as a folder")
    names = archive.namelist()
    if len(set(names)) != len(names):
        raise ValueError("a record stands twice")
    for name in sorted(names):
        content = archive.read(name)
        if not name.endswith(_RECORD):
            # Without the first folder, which torch calls after the file.
            digest.update(f"{name.partition('/')[2]} {len(content)}\n".encode() + content)
    return digest.hexdigest()


class NewPath(click.Path):
    """The name of a folder or file that a command makes anew; nothing may be there yet.

    Args:
        refuse: Raises CalibrationDataError or ExportError for a path that cannot be written.
        name: What the help calls it.
    """

    def __init__(self, refuse: _OfPath = refuse_existing, name: str = "path") -> None:
        super().__init__(path_type=Path)
        self._refuse, self.name = refuse, name

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:  # noqa: ANN401
        """Return the path, if it can be written."""
        path = Path(str(super().convert(value, param, ctx)))
        self._refuse(path)
        return path


REPLACED_FILE = NewPath(partial(file_to_replace, kind=ExportError), "file")
"""The name of a file that a command writes; an older one is replaced."""
