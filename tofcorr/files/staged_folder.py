"""A folder that appears complete or not at all."""

import os
import shutil
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Self

from tofcorr.errors import CalibrationDataError
from tofcorr.files.begun import begin, ended
from tofcorr.files.leftovers import lock, remove_leftovers, temporary_name, unlock
from tofcorr.files.places import cannot_write, refuse_name


class StagedFolder:
    """A temporary folder beside `path`, renamed to `path` when its block ends without an error.

    On any exception, Ctrl-C included, the temporary folder is removed, together with the parent
    folders that were made for it. Temporary folders that killed runs left beside it are removed.

    Args:
        path: The folder to write; nothing may be there yet.

    Raises:
        CalibrationDataError: Something is at `path` already, or it cannot be written.
    """

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        refuse_existing(self.path)
        # absolute() instead of resolve(): a symbolic link in the path is kept.
        target = self.path.absolute()
        self._made_parents: list[Path] = []
        self._held: int | None = None
        self.folder = target.parent / temporary_name(target.name)
        begin(self.folder, self.discard)
        try:
            for folder in reversed([one for one in target.parents if not one.exists()]):
                folder.mkdir()
                self._made_parents.append(folder)
            remove_leftovers(target.parent)
            _try_name(target)
            self.folder.mkdir()
            self._held = lock(self.folder)
        except OSError as error:
            self.discard()
            raise CalibrationDataError(cannot_write(self.path, error)) from None
        except BaseException:  # Ctrl-C, before the block that would handle it has begun.
            self.discard()
            raise

    def commit(self) -> None:
        """Rename the temporary folder to its final name."""
        try:
            _rename_to_new(self.folder, self.path.absolute())
        except OSError as error:
            self.discard()
            raise CalibrationDataError(cannot_write(self.path, error)) from None
        except BaseException:  # Ctrl-C, before the folder had its final name.
            self.discard()
            raise
        self._let_go()
        ended(self.folder)

    def discard(self) -> None:
        """Remove the temporary folder and the parents made for it, if they are empty."""
        shutil.rmtree(self.folder, ignore_errors=True)
        self._let_go()
        for folder in reversed(self._made_parents):
            try:
                folder.rmdir()
            except OSError:
                break
        ended(self.folder)

    def _let_go(self) -> None:
        held, self._held = self._held, None
        unlock(held)

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
        if kind is None:
            self.commit()
        else:
            self.discard()


def _rename_to_new(folder: Path, target: Path) -> None:
    if os.path.lexists(target):
        raise FileExistsError(0, "something appeared there in the meantime")
    folder.rename(target)


def refuse_existing(path: Path) -> None:
    """Refuse a name at which something is, or which cannot be shown.

    Raises:
        CalibrationDataError: A file, a folder or a symbolic link is there, whatever it points to.
    """
    refuse_name(path, CalibrationDataError)
    if os.path.lexists(path):
        raise CalibrationDataError(
            f"{path}: exists already and is not overwritten; remove it or choose another name."
        )


def _try_name(target: Path) -> None:
    """Let the file system refuse a name that it cannot hold, before any work is done."""
    with suppress(FileNotFoundError):
        os.lstat(target)
