"""Numbers in files of unknown origin: text, NPY arrays, and values that a parser has read."""

import re
from collections.abc import Callable
from pathlib import Path
from tokenize import TokenError
from typing import Any

import numpy as np

from tofcorr.errors import CalibrationDataError

_LARGEST_MB = 256
"""Largest text of numbers read, MB: a day of poses at 10 Hz takes 100 MB."""

Line = tuple[int, list[str]]
"""The number of a line, counted from one, and its fields."""


def read_text(path: Path) -> str:
    """Return the text of a file of bounded size.

    Raises:
        CalibrationDataError: There is no such file, it is too large, or it is not text.
    """
    try:
        with path.open("rb") as file:
            content = file.read(_LARGEST_MB * 10**6 + 1)
    except OSError as error:
        raise CalibrationDataError(f"{path}: cannot be read ({error.strerror}).") from None
    if len(content) > _LARGEST_MB * 10**6:
        raise CalibrationDataError(
            f"{path}: larger than {_LARGEST_MB} MB, the limit of a pose file here."
        )
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise CalibrationDataError(
            f"{path}: expected a text file of poses, found binary content."
        ) from None


def lines_of(text: str) -> list[Line]:
    """Return the lines that hold something, with their fields; `#` and `%` begin comments.

    Fields are separated by white space, commas or semicolons.
    """
    contents = (re.sub(r"[#%].*", "", line) for line in text.splitlines())
    split = (re.sub("[,;]", " ", content).split() for content in contents)
    return [(number, fields) for number, fields in enumerate(split, start=1) if fields]


def numbers_in(line: Line, path: Path, counts: tuple[int, ...]) -> np.ndarray:
    """Return the numbers of a line, which must be finite and as many as expected.

    Raises:
        CalibrationDataError: They are not; the message names file and line.
    """
    number, fields = line
    if len(fields) not in counts:
        wanted = " or ".join(map(str, counts))
        raise CalibrationDataError(
            f"{path}, line {number}: expected {wanted} numbers, got {len(fields)}."
        )
    values = any_numbers(fields)
    if not values.size:
        shown = " ".join(fields)[:60]
        raise CalibrationDataError(f"{path}, line {number}: expected numbers, got '{shown}'.")
    if not np.isfinite(values).all():
        raise CalibrationDataError(f"{path}, line {number}: expected finite numbers.")
    return values


def any_numbers(value: Any) -> np.ndarray:  # noqa: ANN401 - from a file
    """Return a value from a file as an array of float64; an empty one if it holds no numbers."""
    try:
        return np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        return np.zeros(0)


def load_numbers(path: Path, refused: Callable[[str], Exception]) -> np.ndarray:
    """Load an NPY array of real numbers.

    Args:
        path: The file.
        refused: Makes an error of what is wrong: the file cannot be read, is damaged, or holds
            something else; a text of one line.
    """
    unreadable = (OSError, EOFError, SyntaxError, TokenError, ArithmeticError, MemoryError)
    try:
        # Mapped, a header that promises more than the file holds is refused before memory is taken.
        array = np.load(path, mmap_mode="r", allow_pickle=False)
    except (*unreadable, ValueError) as error:
        first = (str(error).splitlines() or [type(error).__name__])[0]
        raise refused(f"not a readable NPY array ({first[:150]})") from None
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "fiu":
        raise refused("not an array of numbers")
    return np.array(array)
