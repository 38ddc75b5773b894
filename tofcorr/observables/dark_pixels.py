"""The amplitude of pixels, also of those whose camera states none because they are missing."""

import numpy as np

from tofcorr.observables.observed import Observed
from tofcorr.observables.pixel_table import PixelTable

# Missing pixels have an amplitude of their own if at least this share of them is positive. Chosen:
# cameras write either the measured value or zero.
_RECORDED_SHARE = 0.5
# Knots of the falling-off of light from the image's centre to its corner: powers of the radius.
_RADIAL_POWERS = (0, 2, 4)


def amplitude_everywhere(observed: Observed) -> tuple[np.ndarray, bool]:
    """Return the amplitude of each row of the pixel table, and whether the camera recorded it.

    Where the camera writes no amplitude for missing pixels, it is that of the pixels around the
    same target: cos / d^2 times the fall-off of the lens, fitted in ln amplitude.

    Returns:
        Counts, shape (M,), NaN where unknown; and False if missing pixels were estimated.
    """
    table = observed.table
    lost = table.missing > 0
    raw = table.raw_amplitude
    if not np.isfinite(raw).any():
        return raw, False
    positive = np.isfinite(raw[lost]) & (raw[lost] > 0)
    if not lost.any() or positive.mean() >= _RECORDED_SHARE:
        return raw, True
    estimated = _light_law(observed, table)
    known = np.isfinite(table.amplitude) & ~lost
    return np.where(known, table.amplitude, estimated), False


def _light_law(observed: Observed, table: PixelTable) -> np.ndarray:
    """Return the amplitude that the law of light predicts for each row, counts."""
    height, width = observed.map_frames.shape
    row, column = table.pixel // width, table.pixel % width
    radius = np.hypot(row - (height - 1) / 2, column - (width - 1) / 2) / np.hypot(height, width)
    columns = [radius**power for power in _RADIAL_POWERS]
    columns += [(table.target == number) * 1.0 for number in np.unique(table.target)[1:]]
    design = np.stack(columns, axis=1)
    signal = np.log(np.where(table.signal > 0, table.signal, np.nan))
    known = np.isfinite(signal) & np.isfinite(table.amplitude) & (table.amplitude > 0)
    if known.sum() < design.shape[1]:
        return np.full(len(table), np.nan)
    wanted = np.log(table.amplitude[known]) - signal[known]
    solution = np.linalg.lstsq(design[known], wanted, rcond=None)[0]
    return np.exp(signal + design @ solution)
