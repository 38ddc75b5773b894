"""Groups of pixels by brightness and target, in which recordings of unlike poses are compared."""

from collections.abc import Sequence

import numpy as np

from tofcorr.observables.pixel_table import PixelTable

# Groups of brightness, of equal count in both recordings together. Chosen: noise changes by less
# than a tenth within one.
_GROUPS = 20
# Fewest pixels of a group in either recording: fewer say too little of its mean. Chosen.
_FEWEST = 50


def relative_brightness(
    tables: Sequence[PixelTable], amplitudes: Sequence[np.ndarray]
) -> list[np.ndarray]:
    """Return the brightness of pixels in a unit that two recordings share.

    It is the amplitude over that of the same target, seen head-on at 1 m by the same camera: units
    of amplitude differ between simulators. Without amplitudes in either it is cos / d^2.

    Args:
        tables: The pixels of both.
        amplitudes: Of the pixels of both, counts; NaN where unknown.
    """
    signals = [table.signal for table in tables]
    if not all(np.isfinite(amplitude).any() for amplitude in amplitudes):
        return signals
    scaled = []
    for signal, amplitude in zip(signals, amplitudes, strict=True):
        known = np.isfinite(amplitude) & np.isfinite(signal)
        # The brighter half: there a threshold takes no pixel away.
        known &= signal >= np.median(signal[known]) if known.any() else False
        scale = float(np.median(amplitude[known] / signal[known])) if known.any() else np.nan
        scaled.append(amplitude / scale)
    return scaled


def num_strata(names: Sequence[Sequence[str]]) -> int:
    """Return the number of groups of two recordings with targets of these names."""
    return _GROUPS * max(len(set(names[0]) & set(names[1])), 1)


def common_strata(
    tables: Sequence[PixelTable], names: Sequence[Sequence[str]], brightness: Sequence[np.ndarray]
) -> list[np.ndarray]:
    """Return the group of each pixel of both recordings, by brightness and target.

    Args:
        tables: The pixels of both.
        names: Names of the targets of both, in alphabetical order.
        brightness: Of the pixels of both, in one unit.

    Returns:
        Group numbers, shapes (M,); -1 for pixels without brightness, of a target that only one
        recording has, or of a group with fewer than 50 pixels in either.
    """
    shared = sorted(set(names[0]) & set(names[1]))
    number = {name: k for k, name in enumerate(shared)}
    groups = []
    known = np.concatenate([values[np.isfinite(values)] for values in brightness])
    edges = np.quantile(known, np.linspace(0, 1, _GROUPS + 1)[1:-1]) if len(known) else []
    for table, own, values in zip(tables, names, brightness, strict=True):
        place = np.searchsorted(edges, values)
        if shared:
            of_target = np.array([number.get(name, -1) for name in own])[table.target]
            place = np.where(of_target >= 0, of_target * _GROUPS + place, -1)
        groups.append(np.where(np.isfinite(values), place, -1))
    size = num_strata(names)
    counts = [np.bincount(group[group >= 0], minlength=size) for group in groups]
    enough = np.append((counts[0] >= _FEWEST) & (counts[1] >= _FEWEST), False)
    return [np.where(enough[group], group, -1) for group in groups]
