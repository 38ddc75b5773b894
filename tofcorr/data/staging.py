"""A folder that appears complete or not at all."""

import os
import shutil
import uuid
from pathlib import Path
from types import TracebackType
from typing import Self

from tofcorr.errors import CalibrationDataError


class StagedFolder:
    """A temporary folder beside `path`, renamed to `path` when its block ends without an error.

    On any exception, Ctrl-C included, the temporary folder is removed, together with the parent
    folders that were made for it.

    Args:
        path: The folder to write; it must not exist yet.

    Raises:
        CalibrationDataError: `path` exists already, or cannot be written.
    """

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        if os.path.lexists(self.path):
            raise CalibrationDataError(
                f"{self.path}: exists already and is not overwritten; "
                "remove it or choose another name."
            )
        # absolute() instead of resolve(): a symbolic link in the path is kept.
        target = self.path.absolute()
        missing = [folder for folder in target.parents if not folder.exists()]
        self._made_parents: list[Path] = []
        self.folder = target.parent / f".{target.name}.{uuid.uuid4().hex[:8]}.part"
        try:
            for folder in reversed(missing):
                folder.mkdir()
                self._made_parents.append(folder)
            self.folder.mkdir()
        except OSError as error:
            self.discard()
            raise CalibrationDataError(cannot_write(self.path, error)) from None

    def commit(self) -> None:
        """Rename the temporary folder to its final name."""
        try:
            if os.path.lexists(self.path):
                raise FileExistsError(0, "something appeared there in the meantime")
            self.folder.rename(self.path.absolute())
        except OSError as error:
            self.discard()
            raise CalibrationDataError(cannot_write(self.path, error)) from None

    def discard(self) -> None:
        """Remove the temporary folder and the parents made for it, if they are empty."""
        shutil.rmtree(self.folder, ignore_errors=True)
        for folder in reversed(self._made_parents):
            try:
                folder.rmdir()
            except OSError:
                return

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


def cannot_write(path: Path, error: OSError) -> str:
    """Return the sentence that says why `path` could not be written."""
    return f"{path}: cannot be written ({error.strerror or error})."
