"""The errors that a user can cause and can correct."""

import unicodedata
from difflib import get_close_matches
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable


class TofcorrError(Exception):
    """An error that the user can correct; its message is one sentence for a terminal.

    Args:
        message: The sentence. What it repeats of a file or of a library may hold anything: control
            characters are shown as Python writes them, so that it stays one line.
    """

    def __init__(self, message: str) -> None:
        super().__init__(printable(message))


Kind = type[TofcorrError]
"""Which error a function is to raise: a configuration's, a recording's, an export's."""


def did_you_mean(given: str, known: "Iterable[str]") -> str:
    """Return a sentence that asks whether what resembles a text was meant; empty: nothing does."""
    close = get_close_matches(given, known, n=1)
    return f" Did you mean '{close[0]}'?" if close else ""


def printable(text: str) -> str:
    r"""Return text in one line: newlines, tabs and other control characters as `\n`, `\t`, ..."""
    if text.isprintable():
        return text
    return "".join(repr(one)[1:-1] if is_control(one) else one for one in text)


def is_control(character: str) -> bool:
    """Whether a character moves the cursor, ends the line, or is no text at all."""
    return unicodedata.category(character) in ("Cc", "Cs", "Zl", "Zp")


class ConfigError(TofcorrError, ValueError):
    """A configuration is missing, malformed or not allowed."""


class CalibrationDataError(TofcorrError, ValueError):
    """A recording is broken, or lacks the data for the task."""


class ExportError(TofcorrError, RuntimeError):
    """An exported corrector does not agree with the model it was made from."""


class FrameError(TofcorrError, ValueError):
    """A frame does not fit the camera or the model that it was given to."""


class StateError(TofcorrError, RuntimeError):
    """A saved state belongs to another model than the one that it was to be loaded into."""
