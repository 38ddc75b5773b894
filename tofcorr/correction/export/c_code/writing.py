"""How numbers and words are written in C source."""

from collections.abc import Iterable

import numpy as np

# Numbers in one line of a table (no unit). Chosen: a line of 120 characters.
_IN_A_LINE = 6


def comment(text: str) -> str:
    """Return a text that neither ends a comment nor begins one."""
    return " ".join(text.split()).replace("*/", "* /").replace("/*", "/ *")


def number(value: float) -> str:
    """Return a constant of type float, with all its digits."""
    return _special(value) or f"{np.float32(value):.8e}f"


def long_number(value: float) -> str:
    """Return a constant of type double, with all its digits."""
    return _special(value) or f"{value:.16e}"


def numbers(values: np.ndarray) -> str:
    """Return the entries of a table of floats, as many lines as they take."""
    return lines(map(number, values.ravel()), _IN_A_LINE)


def long_numbers(values: np.ndarray) -> str:
    """Return the entries of a table of doubles, as many lines as they take."""
    return lines(map(long_number, values.ravel()), _IN_A_LINE)


def rows(values: np.ndarray) -> str:
    """Return the rows of a two-dimensional table of floats, each in braces and a line."""
    return "\n".join("  {" + ", ".join(map(number, row)) + "}," for row in values)


def lines(words: Iterable[str], in_a_line: int) -> str:
    """Return words behind commas, so many in a line."""
    every = list(words)
    parts = (every[k : k + in_a_line] for k in range(0, len(every), in_a_line))
    return "\n".join("  " + ", ".join(part) + "," for part in parts)


def _special(value: float) -> str | None:
    if np.isnan(value):
        return "NAN"
    return f"{'-' if value < 0 else ''}INFINITY" if np.isinf(value) else None
