"""Writing a file whole or not at all."""

import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tofcorr.errors import ExportError


@contextmanager
def staged_file(path: Path | str) -> Iterator[Path]:
    """Yield a temporary file beside `path`; it is renamed to `path` if the block succeeds.

    On any exception the temporary file is removed, and an older file at `path` is kept.

    Raises:
        ExportError: The folder does not exist, or the file cannot be written.
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
