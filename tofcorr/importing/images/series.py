"""The images of a folder that a pattern names, in natural order, with the times in their names."""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tofcorr.importing.images.names import matching_files, natural_order
from tofcorr.importing.timing.stamps import in_seconds

_STAMP = re.compile(r"\d+(\.\d+)?")

_LEAST_SECONDS = 1e8
"""Numbers in names count as times from here on, or with a decimal point: in Unix seconds it
is 1973, and no folder has as many images."""


@dataclass(frozen=True, kw_only=True)
class Series:
    """Files that a pattern names.

    Attributes:
        views: What the wildcard stands for in each name, in natural order (2 before 10).
        paths: The files, in the same order.
        times: Seconds, shape (N,), if the views are time stamps; else None.
    """

    views: tuple[str, ...]
    paths: tuple[Path, ...]
    times: np.ndarray | None


def find_series(folder: Path, pattern: str, what: str) -> Series:
    """Find the files of a folder that a pattern names.

    Args:
        folder: Where the pattern starts.
        pattern: File name with `{view}`, or a glob with `*` and `?`; may name sub-folders.
        what: What the files are, for messages.

    Raises:
        CalibrationDataError: There is no such folder, the pattern has no wildcard, or it matches
            nothing.
    """
    found = matching_files(folder, pattern, what)
    views = sorted(found, key=natural_order)
    times = times_in_names(views)
    if times is not None:
        order = np.argsort(times, kind="stable")
        views, times = [views[k] for k in order], times[order]
    return Series(views=tuple(views), paths=tuple(found[view] for view in views), times=times)


def times_in_names(views: list[str]) -> np.ndarray | None:
    """Return the times that all names are, seconds, shape (N,); None if they are none.

    A time is a number with a decimal point, or a whole number of seconds, milliseconds,
    microseconds or nanoseconds since 1970.
    """
    if not all(_STAMP.fullmatch(view) for view in views):
        return None
    values = np.array([float(view) for view in views])
    if all("." in view for view in views):
        return values
    if values.min() < _LEAST_SECONDS:
        return None
    return in_seconds(values)
