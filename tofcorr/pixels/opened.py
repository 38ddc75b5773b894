"""Recordings as callers of the package give them: folders, opened ones, or several of either."""

from collections.abc import Sequence
from os import PathLike
from pathlib import Path

from tofcorr.data.recording import Recording

Recordings = str | PathLike[str] | Recording | Sequence[str | PathLike[str] | Recording]
"""A folder, an opened recording, or a sequence of either."""


def opened(recordings: Recordings) -> tuple[Recording, ...]:
    """Return the recordings, opened.

    Raises:
        CalibrationDataError: A folder holds no recording.
    """
    if isinstance(recordings, (str, PathLike, Recording)):
        recordings = (recordings,)
    return tuple(
        one if isinstance(one, Recording) else Recording.open(Path(one)) for one in recordings
    )
