"""Numbers in files of unknown origin: text, NPY arrays, and values that a parser has read."""

import re
import reprlib
from collections.abc import Callable
from math import inf
from pathlib import Path
from typing import Any

import numpy as np

from tofcorr import options
from tofcorr.errors import CalibrationDataError
from tofcorr.files import MOST_BYTES, UNREADABLE, open_regular
from tofcorr.options import one_line

Line = tuple[int, list[str]]
"""The number of a line, counted from one, and its fields."""


def read_text(path: Path) -> str:
    """Return the text of a file of bounded size, without the mark that some programs begin it with.

    Raises:
        CalibrationDataError: There is no such file, it is too large, or it is not text.
    """
    return options.read_text(path, CalibrationDataError, MOST_BYTES).removeprefix("\ufeff")


def lines_of(text: str) -> list[Line]:
    """Return the lines that hold something, with their fields; `#` and `%` begin comments.

    Fields are separated by white space, commas or semicolons.
    """
    contents = (re.sub(r"[#%].*", "", line) for line in text.splitlines())
    split = (re.sub("[,;]", " ", content).split() for content in contents)
    return [(number, fields) for number, fields in enumerate(split, start=1) if fields]


def finite_numbers(value: Any, where: str, counts: tuple[int, ...] = ()) -> np.ndarray:  # noqa: ANN401
    """Return a value from a file, nested lists too, as a row of float64.

    Raises:
        CalibrationDataError: It holds something else than finite numbers, or not as many as one of
            `counts`, if there are any.
    """
    numbers = any_numbers(value)
    if np.isfinite(numbers).all() and (numbers.size in counts if counts else numbers.ndim):
        return numbers.ravel()
    wanted, shown = " or ".join(map(str, counts)), one_line(reprlib.repr(value))
    raise CalibrationDataError(f"{where}: expected {wanted or 'only'} finite numbers, got {shown}.")


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
    try:
        # Mapped, a header that promises more than the file holds is refused before memory is taken.
        with open_regular(path, inf):
            array = np.load(path, mmap_mode="r", allow_pickle=False)
    except UNREADABLE as error:
        first = (str(error).splitlines() or [type(error).__name__])[0]
        raise refused(f"not a readable NPY array ({first[:150]})") from None
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "fiu":
        raise refused("not an array of numbers")
    return np.array(array)
