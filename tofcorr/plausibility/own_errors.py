"""What a camera's own errors may depend on besides place: amplitude, conditions, and the phase.

A camera whose distances follow its integration time by centimetres is to be calibrated, and no
reason to doubt a recording that says so.
"""

import numpy as np

from tofcorr.conditions import OPTIONAL_CONDITIONS
from tofcorr.geometry.ranges import unambiguous_range
from tofcorr.plausibility.sample import Sample

# Fewest frames from which conditions are taken into account. Chosen: ten determine all the rest.
_FEWEST_FRAMES = 20
# Amplitudes are cut below at this share of their median: the logarithm of none is infinite. Chosen.
_DARKEST = 1e-3
# Waves of the circular error in one unambiguous range: harmonics of four taps (Lange 2000).
_WAVES = (4, 8)


def by_amplitude(sample: Sample) -> np.ndarray:
    """Return the logarithm of the amplitude and its square, standardised, (F, P, 2).

    The last axis has length 0 where no amplitude was recorded.
    """
    if sample.amplitude is None:
        return np.zeros((*sample.stored.shape, 0))
    typical = np.nanmedian(sample.amplitude) if np.isfinite(sample.amplitude).any() else 1.0
    return _by_logarithm(np.nan_to_num(sample.amplitude, nan=typical), float(typical))


def by_matt_wall(cosine: np.ndarray, distance: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Return the same of the amplitude that a matt wall has, for recordings without, (F, P, 2).

    It is the cosine of the angle of incidence over the square of the distance. An error by the
    amplitude changes over a tilted wall as one of focal length or distortion does.

    Args:
        cosine: Of the angle of incidence, shape (F, P).
        distance: Along the rays to the planes, shape (F, P), metres, without noise.
        used: Which pixels are used, shape (F, P).
    """
    amplitude = np.abs(cosine) / distance**2
    typical = float(np.median(amplitude[used])) if used.any() else 1.0
    return _by_logarithm(np.where(used, amplitude, typical), typical)


def _by_logarithm(amplitude: np.ndarray, typical: float) -> np.ndarray:
    least = _DARKEST * max(typical, 1e-12)
    bright = _standardised(np.log(np.maximum(amplitude, least)))
    return np.stack([bright, bright**2], axis=-1)


def by_conditions(sample: Sample) -> np.ndarray:
    """Return the conditions that were recorded of all frames and differ, standardised, (F, K).

    K is 0 where there are few frames.
    """
    found = []
    for one in OPTIONAL_CONDITIONS if len(sample.frames) >= _FEWEST_FRAMES else ():
        values = sample.column(one.name)
        if values is None or not np.isfinite(values).all():
            continue
        values = np.log(values) if one.positive else values
        if np.ptp(values) > 0:
            found.append(_standardised(values))
    return np.stack(found, axis=-1) if found else np.zeros((len(sample.frames), 0))


def by_phase(distance: np.ndarray, used: np.ndarray, frequency: float | None) -> np.ndarray:
    """Return sine and cosine of the waves of the circular error at distances, metres, (F, P, 4).

    The last axis has length 0 where the modulation frequency (Hz) is unknown, or where the
    distances used span less than one wave: straight pieces over the distance follow that much.
    """
    longest = unambiguous_range(frequency) / _WAVES[0] if frequency else np.inf
    span = np.ptp(distance[used]) if used.any() else 0.0
    if len(distance) < _FEWEST_FRAMES or span < longest:
        return np.zeros((*distance.shape, 0))
    phase = 2 * np.pi / longest * distance[..., None] * (np.array(_WAVES) / _WAVES[0])
    return np.concatenate([np.sin(phase), np.cos(phase)], axis=-1)


def _standardised(values: np.ndarray) -> np.ndarray:
    return (values - values.mean()) / max(float(values.std()), 1e-12)
