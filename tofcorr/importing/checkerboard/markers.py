"""Dictionaries of markers, by the names that OpenCV gives them."""

import cv2

from tofcorr.errors import ConfigError

FEWEST_CORNERS = 8
"""Fewer points of a board (no unit) do not place it: two tags, or a fifth of a small ChArUco board.
Set by hand."""

_PREFIX = "DICT_"


def marker_dictionary(name: str) -> cv2.aruco.Dictionary:
    """Return a dictionary by its name, with or without `DICT_` in front.

    Raises:
        ConfigError: There is no such dictionary.
    """
    wanted = f"{_PREFIX}{name.upper().removeprefix(_PREFIX)}"
    known = {key.upper(): key for key in dir(cv2.aruco) if key.startswith(_PREFIX)}
    if wanted not in known:
        listed = ", ".join(sorted(key.removeprefix(_PREFIX) for key in known))
        raise ConfigError(f"There is no dictionary of markers '{name}'. Known: {listed}.")
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, known[wanted]))
