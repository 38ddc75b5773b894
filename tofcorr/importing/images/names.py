"""The files of a folder that a pattern names, by the text that its wildcards stand for."""

import re
from pathlib import Path

from tofcorr.errors import CalibrationDataError

_WILDCARD = re.compile(r"(\{view\}|\*|\?)")
_GROUPS = {"{view}": "([^/]+)", "*": "([^/]*)", "?": "([^/])"}


def matching_files(folder: Path, pattern: str, what: str) -> dict[str, Path]:
    """Find the files that a pattern names.

    Args:
        folder: Where the pattern starts.
        pattern: File name with `{view}`, or a glob with `*` and `?`; may name sub-folders.
        what: What the files are, for messages.

    Returns:
        The files by the text that the wildcards stand for; several texts are joined by "-".

    Raises:
        CalibrationDataError: There is no such folder, the pattern has no wildcard, or it matches
            nothing.
    """
    if not folder.is_dir():
        raise CalibrationDataError(f"{folder}: there is no such folder.")
    parts = _WILDCARD.split(pattern)
    if len(parts) == 1:
        raise CalibrationDataError(
            f"the {what} pattern '{pattern}' names one file; put {{view}} or * where the images "
            "differ."
        )
    regex = re.compile("".join(_GROUPS.get(part, re.escape(part)) for part in parts))
    found: dict[str, Path] = {}
    for path in folder.glob("/".join("*" * (pattern.count("/") + 1))):
        match = regex.fullmatch(path.relative_to(folder).as_posix())
        if match and path.is_file():
            found["-".join(match.groups())] = path
    if not found:
        raise CalibrationDataError(
            f"{folder}: no file matches the {what} pattern '{pattern}'; {_content(folder)}."
        )
    return found


def natural_order(text: str) -> list[tuple[int, str]]:
    """Return a key that sorts numbers in names by their value."""
    return [(int(p), "") if p.isdecimal() else (-1, p) for p in re.split(r"(\d+)", text)]


def _content(folder: Path) -> str:
    names = sorted((path.name for path in folder.iterdir()), key=natural_order)
    if not names:
        return "the folder is empty"
    return f"it holds {len(names)} entries such as '{names[0]}' and '{names[-1]}'"
