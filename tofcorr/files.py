"""Files and folders that appear whole or not at all, and what a killed run leaves of them.

What is being written has a temporary name that is known again, is locked while in use, and is
removed however its block ends. An archive carries a digest: a change of any byte is noticed.
"""

import io
import json
import logging
import lzma
import os
import re
import shutil
import tempfile
import uuid
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from hashlib import sha256
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import click

from tofcorr.errors import CalibrationDataError, ExportError, TofcorrError, is_control

try:
    import fcntl
except ImportError:  # Not on Windows: leftovers are then named, and never removed.
    fcntl = None

_LOG = logging.getLogger("tofcorr")
_OURS = re.compile(r"\..+\.tofcorr-[0-9a-f]{8}\.part[^/]*|tofcorr-scratch-[0-9a-f]{8}", re.DOTALL)
_LONGEST_NAME = 120
"""Longest part of a file's name that its temporary name repeats, bytes. File systems take 255 in
all; the rest is for the suffix and the mark. Set by hand."""
_BEGUN: dict[Path, Callable[[], object]] = {}
"""How to remove each temporary file and folder that this process has begun."""


@contextmanager
def staged_file(path: Path | str, kind: type[TofcorrError] = ExportError) -> Iterator[Path]:
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
    path = Path(path)
    target = file_to_replace(path, kind)
    remove_leftovers(target.parent)
    part = target.with_name(temporary_name(target.stem, target.suffix))
    try:
        with _temporary(part, lambda: part.touch(exist_ok=False)):
            yield part
            part.replace(target)
    except OSError as error:
        raise kind(cannot_write(path, error)) from None


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


class StagedFolder:
    """A temporary folder beside `path`, renamed to `path` when its block ends without an error.

    On any exception, Ctrl-C included, the temporary folder is removed, together with the parent
    folders that were made for it. Temporary folders that killed runs left beside it are removed.

    Args:
        path: The folder to write; nothing may be there yet.

    Raises:
        CalibrationDataError: Something is at `path` already, or it cannot be written.

    Attributes:
        path: The folder to write.
        folder: The temporary folder: files are written here.
    """

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        refuse_existing(self.path)
        # absolute() instead of resolve(): a symbolic link in the path is kept.
        target = self.path.absolute()
        self.folder = target.parent / temporary_name(target.name)
        self._made = ExitStack()
        _BEGUN[self.folder] = self.discard
        with self._discarded_on_error():
            for folder in reversed([one for one in target.parents if not one.exists()]):
                folder.mkdir()
                self._made.callback(_remove_empty, folder)
            remove_leftovers(target.parent)
            # The file system refuses a name that it cannot hold before any work is done.
            with suppress(FileNotFoundError):
                os.lstat(target)
            self._made.enter_context(_temporary(self.folder, self.folder.mkdir))

    def commit(self) -> None:
        """Rename the temporary folder to its final name."""
        target = self.path.absolute()
        with self._discarded_on_error():
            if os.path.lexists(target):
                raise FileExistsError(0, "something appeared there in the meantime")
            self.folder.rename(target)
        self.discard()

    def discard(self) -> None:
        """Remove the temporary folder, if it is still there, and the parents that are empty."""
        _remove(self.folder)
        self._made.close()
        _BEGUN.pop(self.folder, None)

    def __enter__(self) -> Self:
        """Return the object; files are written to its `folder`."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Rename the folder into place, or remove it after an exception."""
        self.commit() if kind is None else self.discard()

    @contextmanager
    def _discarded_on_error(self) -> Iterator[None]:
        try:
            yield
        except BaseException as error:  # Ctrl-C too, which no block may handle yet.
            self.discard()
            if isinstance(error, OSError):
                raise CalibrationDataError(cannot_write(self.path, error)) from None
            raise


def remove_begun() -> None:
    """Remove what an interruption kept from being removed.

    Python may raise `KeyboardInterrupt` between any two steps: before a block has begun that would
    tidy up, or while it does so. The program calls this when it has been stopped.
    """
    for path, undo in list(_BEGUN.items()):
        with suppress(OSError):
            undo()
        _BEGUN.pop(path, None)


def remove_leftovers(folder: Path) -> None:
    """Remove what killed runs left in a folder and among the system's temporary files; say so.

    What another process is writing is locked, and stays. What cannot be removed is named.
    """
    for path in [*_leftovers(folder), *_leftovers(Path(tempfile.gettempdir()))]:
        descriptor = None
        try:
            if fcntl is None:
                raise OSError("locks are unknown here")  # noqa: TRY301 - handled as the others
            descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW)
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            shutil.rmtree(path) if path.is_dir() else path.unlink()
            _LOG.warning("Removed %s, which a killed run had left.", path)
        except (BlockingIOError, FileNotFoundError):
            continue  # In use, or removed by another process in the same moment.
        except OSError:
            _LOG.warning("%s may be what a killed run left; if so, remove it.", path)
        finally:
            if descriptor is not None:
                os.close(descriptor)


def temporary_name(name: str, suffix: str = "") -> str:
    """Return a hidden name, never used before, for what will be called `name + suffix`."""
    # torch calls the folder inside an archive after its file: plain names serve all programs.
    if len(name) > _LONGEST_NAME or not name.isascii():
        name = sha256(os.fsencode(name)).hexdigest()[:16]
    if len(suffix) > _LONGEST_NAME or not suffix.isascii():
        suffix = ""
    return f".{name}.tofcorr-{uuid.uuid4().hex[:8]}.part{suffix}"


def cannot_write(path: Path, error: OSError) -> str:
    """Return the sentence that says why `path` could not be written."""
    return f"{path}: cannot be written ({error.strerror or error})."


def refuse_existing(path: Path) -> None:
    """Refuse a name at which something is, or which cannot be shown.

    Raises:
        CalibrationDataError: A file, a folder or a symbolic link is there, whatever it points to.
    """
    _refuse_name(path, CalibrationDataError)
    if os.path.lexists(path):
        raise CalibrationDataError(
            f"{path}: exists already and is not overwritten; remove it or choose another name."
        )


def file_to_replace(path: Path, kind: type[TofcorrError]) -> Path:
    """Return the file that a name means: a symbolic link stands for what it points to.

    Args:
        path: Where a file is to be written; an older file there may be replaced.
        kind: The error to raise.

    Raises:
        TofcorrError: The name cannot be shown, its folder does not exist, or a folder, a device or
            a pipe is there.
    """
    _refuse_name(path, kind)
    try:
        target = Path(os.path.realpath(path, strict=False))
        if path.is_symlink() and target.is_symlink():
            raise kind(f"{path}: is a symbolic link that leads to itself; remove it.")
        if not target.parent.is_dir():
            raise kind(f"{path}: its folder does not exist; make it first.")
        if target.is_dir():
            raise kind(f"{path}: is a folder; give the name of a file.")
        if target.exists() and not target.is_file():
            raise kind(f"{path}: is a device or a pipe, not a file; give the name of a file.")
    except OSError as error:  # For example a name too long for the file system.
        raise kind(cannot_write(path, error)) from None
    return target


def _refuse_name(path: Path, kind: type[TofcorrError]) -> None:
    """Refuse the name of an output that messages, logs and YAML cannot show."""
    if any(map(is_control, str(path))):
        raise kind(
            f"{path}: the name holds a control character, or is not text; choose another one."
        )


@contextmanager
def _temporary(path: Path, make: Callable[[], object]) -> Iterator[None]:
    """Make a temporary file or folder, locked for the length of the block and removed after it.

    The operating system lets go of the lock when the process ends, however it ends.
    """
    held = None
    _BEGUN.setdefault(path, lambda: _remove(path))
    try:
        make()
        held = _lock(path)
        yield
    finally:
        _remove(path)
        _BEGUN.pop(path, None)
        if held is not None:
            os.close(held)


def _lock(path: Path) -> int | None:
    """Mark a temporary file or folder as in use until the descriptor that is returned is closed.

    Returns:
        None where the file system knows no locks.

    Raises:
        FileExistsError: Another process took `path` for a leftover in the same moment.
        OSError: `path` cannot be opened.
    """
    if fcntl is None:
        return None
    descriptor = os.open(path, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        same = os.path.samestat(os.fstat(descriptor), os.lstat(path))
    except (BlockingIOError, FileNotFoundError):
        same = False
    except OSError:  # A file system without locks.
        os.close(descriptor)
        return None
    if not same:
        os.close(descriptor)
        raise FileExistsError(0, "another process removed a temporary file; try again")
    return descriptor


def _leftovers(folder: Path) -> Iterator[Path]:
    """Yield what killed runs of this user left in a folder, which other users may share."""
    with suppress(OSError):
        for path in sorted(one for one in folder.iterdir() if _OURS.fullmatch(one.name)):
            with suppress(OSError):
                own = not hasattr(os, "getuid") or path.lstat().st_uid == os.getuid()
                if own and not path.is_symlink():
                    yield path


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    with suppress(OSError):
        path.unlink()


def _remove_empty(folder: Path) -> None:
    with suppress(OSError):
        folder.rmdir()


_RECORD = "extra/tofcorr_seal"

# What zipfile and the decompressors raise on a damaged archive.
_UNREADABLE = (OSError, ValueError, KeyError, EOFError, NotImplementedError, RuntimeError)
_UNREADABLE += (zipfile.BadZipFile, zlib.error, lzma.LZMAError, TypeError, MemoryError)

# Attribute of a folder in a zip archive, as DOS had it. torch takes what is marked so for empty and
# leaves the memory of its numbers as it was; zipfile reads it.
_FOLDER = 0x10

_MOST_BYTES = 2_000_000_000
"""Most bytes of all records, unpacked. Chosen: a small archive can be made to unpack to any size; a
fixed pattern of a camera of 16 megapixels takes 134 MB."""


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


def refuse_damaged(path: Path, what: str) -> None:
    """Refuse an archive whose content is not what was written.

    Every record is compared with its own checksum. An archive with a seal is also compared with
    that; files of older versions have none.

    Args:
        path: The file.
        what: What it should be, for the message.

    Raises:
        CalibrationDataError: It is damaged, or was changed after it was written.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            sealed = [name for name in archive.namelist() if name.endswith(_RECORD)]
            found = _digest(archive)
            stored = json.loads(archive.read(sealed[0]))["sha256"] if sealed else found
    except FileNotFoundError:
        raise CalibrationDataError(f"{path}: there is no such file.") from None
    except IsADirectoryError:
        raise CalibrationDataError(f"{path}: is a folder; expected {what}, a file.") from None
    except _UNREADABLE:
        if not zipfile.is_zipfile(path):
            raise CalibrationDataError(f"{path}: is not {what}, or is cut short.") from None
        raise CalibrationDataError(f"{path}: is damaged; expected {what}.") from None
    if stored != found or len(sealed) > 1:
        raise CalibrationDataError(f"{path}: was changed after it was written; expected {what}.")


def _digest(archive: zipfile.ZipFile) -> str:
    """Return the digest of all records but the seal; reading compares their checksums."""
    digest = sha256()
    if sum(entry.file_size for entry in archive.infolist()) > _MOST_BYTES:
        raise ValueError("it unpacks to too much")
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
    """The name of a folder or file that a command makes anew; nothing may be there yet."""

    refuse: Callable[[Path], object] = staticmethod(refuse_existing)
    called = "path"

    def __init__(self) -> None:
        super().__init__(path_type=Path)
        self.name = self.called

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:  # noqa: ANN401
        """Return the path; raise CalibrationDataError or ExportError if it cannot be written."""
        path = Path(str(super().convert(value, param, ctx)))
        self.refuse(path)
        return path


class ReplacedFile(NewPath):
    """The name of a file that a command writes; an older one is replaced."""

    called = "file"
    refuse = staticmethod(partial(file_to_replace, kind=ExportError))
