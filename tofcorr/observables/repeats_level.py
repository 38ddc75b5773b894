"""How much larger or smaller noise is in repeated frames than neighbouring pixels make it seem."""

import numpy as np

# Pixels of like brightness that give one level, and the fewest that do if there are no more. Three
# frames of a pose leave each pixel two degrees of freedom: the variance of 500 is known to 5 %,
# that of 100 to 10 %.
_PER_LEVEL, _FEWEST = 500, 100
# Most levels. Chosen, as many as bins of the noise curve.
_MOST = 24


def level_of_repeats(
    brightness: np.ndarray, repeats: np.ndarray, neighbours: np.ndarray
) -> np.ndarray:
    """Return the variance of repeats over that of neighbours, at each pixel's brightness.

    Neighbours also see the structure of a scene, such as the rim of saturated patches. It is where
    pixels are bright: one level for all would take it from the noise of the dark ones.

    Args:
        brightness: Of the pixels, any unit, shape (M,); NaN where unknown.
        repeats: Variance over repeated frames, shape (M,), m^2; NaN where there are none.
        neighbours: Variance by differences of neighbours, shape (M,), m^2; NaN where unknown.

    Returns:
        Shape (M,); 1 if fewer than 100 pixels have both variances.
    """
    known = np.isfinite(repeats) & np.isfinite(neighbours) & (np.nan_to_num(brightness) > 0)
    both = np.flatnonzero(known)
    if len(both) < _FEWEST:
        return np.ones_like(neighbours)
    order = both[np.argsort(brightness[both], kind="stable")]
    at, levels = [], []
    for members in np.array_split(order, np.clip(len(order) // _PER_LEVEL, 1, _MOST)):
        seen = float(neighbours[members].sum())
        if seen > 0:
            at.append(float(np.median(np.log(brightness[members]))))
            levels.append(float(repeats[members].sum()) / seen)
    if not levels:
        return np.ones_like(neighbours)
    here = np.log(np.where(np.nan_to_num(brightness) > 0, brightness, np.exp(at[0])))
    return np.interp(here, at, levels)
