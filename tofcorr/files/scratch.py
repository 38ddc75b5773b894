"""A folder among the system's temporary files, for the length of a block."""

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tofcorr.files.begun import begin, ended
from tofcorr.files.leftovers import lock, remove_leftovers, scratch_name, unlock


@contextmanager
def scratch_folder() -> Iterator[Path]:
    """Yield an empty folder that is removed when the block ends.

    Those that killed runs left are removed first.

    Raises:
        OSError: It cannot be made.
    """
    parent = Path(tempfile.gettempdir())
    remove_leftovers(parent)
    folder = parent / scratch_name()
    held = None
    begin(folder, lambda: shutil.rmtree(folder, ignore_errors=True))
    try:
        folder.mkdir(mode=0o700)
        held = lock(folder)
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        ended(folder)
        unlock(held)
