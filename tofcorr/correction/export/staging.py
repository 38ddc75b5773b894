"""A file that appears whole or not at all."""

import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tofcorr.errors import ExportError


@contextmanager
def staged_file(path: Path | str) -> Iterator[Path]:
    """Give a temporary sibling of `path`, renamed to it when the block ends well.

    On any exception the temporary file is removed, and an older file at `path` stays.

    Raises:
        ExportError: The folder does not exist, or the disk refuses.
    """
    path = Path(path)
    if not path.absolute().parent.is_dir():
        raise ExportError(f"{path}: its folder does not exist; make it first.")
    if path.is_dir():
        raise ExportError(f"{path}: is a folder; give the name of a file.")
    part = path.with_name(f".{path.stem}.{uuid.uuid4().hex[:8]}.part{path.suffix}")
    try:
        yield part
        part.replace(path)
    except OSError as error:
        raise ExportError(f"{path}: cannot be written ({error.strerror or error}).") from None
    finally:
        part.unlink(missing_ok=True)
