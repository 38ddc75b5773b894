"""What a killed run leaves behind: named so that it is known again, locked while it is in use."""

import logging
import os
import re
import shutil
import tempfile
import uuid
from collections.abc import Iterator
from contextlib import suppress
from hashlib import sha256
from pathlib import Path

try:
    import fcntl
except ImportError:  # Not on Windows: leftovers are then named, and never removed.
    fcntl = None

_LOG = logging.getLogger("tofcorr")
_OURS = re.compile(r"\..+\.tofcorr-[0-9a-f]{8}\.part[^/]*|tofcorr-scratch-[0-9a-f]{8}", re.DOTALL)
_LONGEST_NAME = 120
"""Longest part of a file's name that its temporary name repeats, bytes. File systems take 255 in
all; the rest is for the suffix and the mark. Set by hand."""


def temporary_name(name: str, suffix: str = "") -> str:
    """Return a hidden name, never used before, for what will be called `name + suffix`."""
    kept = name
    # torch calls the folder inside an archive after its file: plain names serve all programs.
    if len(name) > _LONGEST_NAME or not name.isascii():
        kept = sha256(os.fsencode(name)).hexdigest()[:16]
    if len(suffix) > _LONGEST_NAME or not suffix.isascii():
        suffix = ""
    return f".{kept}.tofcorr-{uuid.uuid4().hex[:8]}.part{suffix}"


def scratch_name() -> str:
    """Return a name, never used before, for a folder among the system's temporary files."""
    return f"tofcorr-scratch-{uuid.uuid4().hex[:8]}"


def lock(path: Path) -> int | None:
    """Mark a temporary file or folder as in use, until the process ends or `unlock` is called.

    The operating system lets go of the lock when the process ends, however it ends.

    Returns:
        What `unlock` takes; None where the file system knows no locks.

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


def unlock(descriptor: int | None) -> None:
    """Let go of what `lock` returned."""
    if descriptor is not None:
        os.close(descriptor)


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
            unlock(descriptor)


def _leftovers(folder: Path) -> Iterator[Path]:
    with suppress(OSError):
        for path in sorted(one for one in folder.iterdir() if _OURS.fullmatch(one.name)):
            if not path.is_symlink() and _is_own(path):
                yield path


def _is_own(path: Path) -> bool:
    """Whether the user of this process owns `path`: the system's temporary folder is shared."""
    try:
        return not hasattr(os, "getuid") or path.lstat().st_uid == os.getuid()
    except OSError:
        return False
