"""Rows of numbers in a text file, with the line they stand on."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from tofcorr.errors import CalibrationDataError

_MOST_BYTES = 256_000_000
"""Largest pose file read, bytes: a day of poses at 10 Hz takes 100 MB."""


class Line(NamedTuple):
    """One line of a file that is neither empty nor a comment.

    Attributes:
        number: Counted from one.
        fields: Its fields, separated by white space or commas.
    """

    number: int
    fields: list[str]


def read_text(path: Path) -> str:
    """Return the text of a file of bounded size.

    Raises:
        CalibrationDataError: There is no such file, it is too large, or it is not text.
    """
    try:
        with path.open("rb") as file:
            content = file.read(_MOST_BYTES + 1)
    except OSError as error:
        raise CalibrationDataError(f"{path}: cannot be read ({error.strerror}).") from None
    if len(content) > _MOST_BYTES:
        raise CalibrationDataError(
            f"{path}: larger than {_MOST_BYTES / 1e6:g} MB, the limit of a pose file here."
        )
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise CalibrationDataError(
            f"{path}: expected a text file of poses, found binary content."
        ) from None


def lines_of(text: str) -> list[Line]:
    """Return the lines that hold something; `#` and `%` begin comments."""
    found = []
    for number, line in enumerate(text.splitlines(), start=1):
        content = line.split("#", 1)[0].split("%", 1)[0].replace(",", " ").replace(";", " ").split()
        if content:
            found.append(Line(number, content))
    return found


def numbers_of(line: Line, path: Path, counts: tuple[int, ...]) -> np.ndarray:
    """Return the numbers of a line.

    Raises:
        CalibrationDataError: A field is no finite number, or there are not as many as expected.
    """
    if len(line.fields) not in counts:
        wanted = " or ".join(map(str, counts))
        raise CalibrationDataError(
            f"{path}, line {line.number}: expected {wanted} numbers, got {len(line.fields)}."
        )
    try:
        values = np.array([float(field) for field in line.fields])
    except ValueError:
        shown = " ".join(line.fields)[:60]
        raise CalibrationDataError(
            f"{path}, line {line.number}: expected numbers, got '{shown}'."
        ) from None
    if not np.isfinite(values).all():
        raise CalibrationDataError(f"{path}, line {line.number}: expected finite numbers.")
    return values
