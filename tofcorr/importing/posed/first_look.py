"""One pass over the images before anything is chosen: size of the depth, and change by time."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from tofcorr.errors import CalibrationDataError
from tofcorr.importing.report import Refusal, RefusedViewError
from tofcorr.importing.source import DepthSource

_LOOKED_AT = 4096
"""Pixels of an image that are compared with the image before: their median change is known to a
sixtieth of the noise, a fraction of a millimetre."""


@dataclass(frozen=True, kw_only=True, eq=False)
class FirstLook:
    """What a quick pass over all images shows.

    Attributes:
        readable: Which images can be read, shape (I,), bool.
        median_depth: Median depth of each image, shape (I,), metres; NaN without returns.
        returns: Share of the pixels with a return, shape (I,).
        change: Median absolute difference to the readable image before, shape (I,), metres; NaN for
            the first one, or where no pixel has a return in both.
        refused: The images that cannot be read, and why.
    """

    readable: np.ndarray
    median_depth: np.ndarray
    returns: np.ndarray
    change: np.ndarray
    refused: list[Refusal]


def look(source: DepthSource, progress: Callable[[Iterable[int], str], Iterable[int]]) -> FirstLook:
    """Read every image once, and keep a few numbers of each.

    Raises:
        CalibrationDataError: No image can be read.
    """
    count = len(source.names)
    readable = np.zeros(count, dtype=bool)
    median, returns, change = (np.full(count, np.nan) for _ in range(3))
    refused: list[Refusal] = []
    before: np.ndarray | None = None
    for k in progress(range(count), "looking at images"):
        try:
            depth = source.read(k).depth
        except RefusedViewError as refusal:
            refused.append(Refusal(view=source.names[k], reason=str(refusal)))
            continue
        few = depth.ravel()[:: max(1, depth.size // _LOOKED_AT)]
        seen = np.isfinite(few)
        readable[k], returns[k] = True, seen.mean()
        if seen.any():
            median[k] = np.median(few[seen])
        if before is not None:
            both = seen & np.isfinite(before)
            if both.any():
                change[k] = np.median(np.abs(few[both] - before[both]))
        before = few
    if not readable.any():
        reason = f"; the first: {refused[0].reason}" if refused else ""
        raise CalibrationDataError(
            f"{source.origin}: none of {count} depth images can be used{reason}."
        )
    return FirstLook(
        readable=readable, median_depth=median, returns=returns, change=change, refused=refused
    )
