"""Where a command is to write, as an argument of its command line: refused before any work."""

from pathlib import Path
from typing import Any

import click

from tofcorr.errors import ExportError
from tofcorr.files.staged import file_to_replace, refuse_existing


class NewPath(click.Path):
    """The name of a folder or file that a command makes anew; nothing may be there yet."""

    def __init__(self) -> None:
        super().__init__(path_type=Path)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:  # noqa: ANN401
        """Return the path; raise CalibrationDataError if something is there."""
        path = Path(str(super().convert(value, param, ctx)))
        refuse_existing(path)
        return path


class ReplacedFile(click.Path):
    """The name of a file that a command writes; an older one is replaced."""

    def __init__(self) -> None:
        super().__init__(path_type=Path)
        self.name = "file"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:  # noqa: ANN401
        """Return the path; raise ExportError if no file can be written there."""
        path = Path(str(super().convert(value, param, ctx)))
        file_to_replace(path, ExportError)
        return path
