"""A file that appears whole or not at all."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tofcorr.errors import ExportError, TofcorrError
from tofcorr.files.begun import begin, ended
from tofcorr.files.leftovers import lock, remove_leftovers, temporary_name, unlock
from tofcorr.files.places import cannot_write, file_to_replace


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
    held = None
    begin(part, lambda: part.unlink(missing_ok=True))
    try:
        part.touch(exist_ok=False)
        held = lock(part)
        yield part
        part.replace(target)
    except OSError as error:
        raise kind(cannot_write(path, error)) from None
    finally:
        part.unlink(missing_ok=True)
        ended(part)
        unlock(held)
