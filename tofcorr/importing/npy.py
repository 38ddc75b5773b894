"""NPY arrays of unknown origin."""

from pathlib import Path
from tokenize import TokenError

import numpy as np

_NUMBERS = "fiu"
"""Kinds of NumPy's types that are real numbers."""


def load_numbers(path: Path) -> np.ndarray:
    """Load an array of real numbers.

    Raises:
        ValueError: The file cannot be read, is damaged, or holds something else; the message is one
            line.
    """
    try:
        # Mapped, a header that promises more than the file holds is refused before memory is taken.
        array = np.load(path, mmap_mode="r", allow_pickle=False)
    except (
        OSError,
        ValueError,
        EOFError,
        SyntaxError,
        TokenError,
        ArithmeticError,
        MemoryError,
    ) as error:
        first = (str(error).splitlines() or [type(error).__name__])[0]
        raise ValueError(f"not a readable NPY array ({first[:150]})") from None
    if not isinstance(array, np.ndarray) or array.dtype.kind not in _NUMBERS:
        raise ValueError("not an array of numbers")
    return np.array(array)
