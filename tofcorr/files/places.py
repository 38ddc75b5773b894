"""Where a command may write, and in what words it says that it cannot."""

import os
from pathlib import Path

from tofcorr.errors import TofcorrError, is_control


def cannot_write(path: Path, error: OSError) -> str:
    """Return the sentence that says why `path` could not be written."""
    return f"{path}: cannot be written ({error.strerror or error})."


def refuse_name(path: Path, kind: type[TofcorrError]) -> None:
    """Refuse the name of an output that messages, logs and YAML cannot show.

    Args:
        path: Where something is to be written.
        kind: The error to raise.

    Raises:
        TofcorrError: It holds a control character, such as a newline, or bytes that are no text.
    """
    if any(map(is_control, str(path))):
        raise kind(
            f"{path}: the name holds a control character, or is not text; choose another one."
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
    refuse_name(path, kind)
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
