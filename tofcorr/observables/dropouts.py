"""Measures how many pixels have no distance or are saturated, where, and at which amplitude."""

from dataclasses import dataclass

import numpy as np

from tofcorr.data.recording import Recording
from tofcorr.observables.dark_pixels import amplitude_everywhere
from tofcorr.observables.image_border import border_of
from tofcorr.observables.models import DropoutModel
from tofcorr.observables.observed import Observed, observe

# Bins of ln amplitude that the model is fitted to: of equal count, and finer ones of the darkest
# pixels, of which a camera may lose only a few. Set by hand: finer than any transition width.
_BINS, _DARK_BINS = 200, 40
# The dependence on the amplitude is kept if it raises the log likelihood of the missing poses by at
# least this much a pose that shows any: half the 95 % quantile of chi-square with two degrees of
# freedom, the two numbers that it adds.
_LEAST_GAIN = 3.0
# Narrowest and widest transition, in ln amplitude. A sharper one is a step in every camera.
_WIDTHS = (0.01, 2.0)
# Pixels that share the largest amplitude make it a saturation if they are at least this share of
# all, and this many. Chosen: random amplitudes hardly ever agree.
_PILED_SHARE = 1e-4
_PILED_PIXELS = 20


@dataclass(frozen=True, kw_only=True, eq=False)
class DropoutMeasurement:
    """Missing and saturated pixels of a recording, among those on the target.

    Attributes:
        model: The probability that a pixel is missing.
        share: Share without a distance.
        saturated_share: Share at or above the saturation amplitude.
        saturated_missing: Share that is saturated and has no distance.
        pose_share: Share without a distance in each pose, shape (P,); NaN without a pixel.
        map: Share of each pixel, shape (H, W); NaN where it never looked at the target.
        border_share: Share in the outer eighth of the image on each side.
        centre_share: Share in the rest.
        amplitude: Amplitude of each row of the pixel table, counts, also where a pixel is missing;
            NaN where unknown.
        amplitude_recorded: Whether missing pixels have an amplitude of their own. If not, theirs
            was estimated from the other pixels.
        observed: What it was measured from.
    """

    model: DropoutModel
    share: float
    saturated_share: float
    saturated_missing: float
    pose_share: np.ndarray
    map: np.ndarray
    border_share: float
    centre_share: float
    amplitude: np.ndarray
    amplitude_recorded: bool
    observed: Observed


def measure_dropouts(recording: Recording) -> DropoutMeasurement:
    """Measure the missing and saturated pixels of a recording.

    Args:
        recording: Any recording, real or simulated. Without a mask, every pixel counts as on the
            target.

    Raises:
        CalibrationDataError: No image has 100 usable pixels, or a frame breaks the format.
    """
    return dropouts_of(observe(recording))


def dropouts_of(observed: Observed) -> DropoutMeasurement:
    """Measure the missing and saturated pixels of a recording that was read."""
    amplitude, recorded = amplitude_everywhere(observed)
    saturation = _saturation(observed, amplitude)
    pixels = observed.pose_pixels
    saturated = observed.pose_saturated.sum() / max(pixels.sum(), 1)
    if saturation is not None and observed.recording.saturation_amplitude is None:
        frames = observed.table.frames
        saturated = frames[amplitude >= saturation].sum() / frames.sum()
    shares = np.divide(
        observed.pose_missing, pixels, out=np.full(len(pixels), np.nan), where=pixels > 0
    )
    border = border_of(observed.map_frames.shape)
    return DropoutMeasurement(
        model=_fitted(observed, amplitude, saturation),
        share=float(observed.pose_missing.sum() / max(pixels.sum(), 1)),
        saturated_share=float(saturated),
        saturated_missing=_saturated_missing(observed, amplitude, saturation),
        pose_share=shares,
        map=np.divide(
            observed.map_missing,
            observed.map_frames,
            out=np.full(border.shape, np.nan),
            where=observed.map_frames > 0,
        ),
        border_share=_share(observed, border),
        centre_share=_share(observed, ~border),
        amplitude=amplitude,
        amplitude_recorded=recorded,
        observed=observed,
    )


def _saturation(observed: Observed, amplitude: np.ndarray) -> float | None:
    """Return the saturation amplitude: as recorded, or where many pixels share the largest."""
    if observed.recording.saturation_amplitude is not None:
        return observed.recording.saturation_amplitude
    known = amplitude[np.isfinite(amplitude)]
    if not len(known):
        return None
    piled = int((known == known.max()).sum())
    enough = max(_PILED_PIXELS, _PILED_SHARE * len(known))
    return float(known.max()) if piled >= enough else None


def _saturated_missing(
    observed: Observed, amplitude: np.ndarray, saturation: float | None
) -> float:
    table = observed.table
    if saturation is None:
        return 0.0
    return float(table.missing[amplitude >= saturation].sum() / max(table.frames.sum(), 1))


def _share(observed: Observed, where: np.ndarray) -> float:
    frames = observed.map_frames[where].sum()
    return float(observed.map_missing[where].sum() / frames) if frames else 0.0


def _fitted(observed: Observed, amplitude: np.ndarray, saturation: float | None) -> DropoutModel:
    """Fit the model by maximum likelihood."""
    from scipy.optimize import minimize  # Slow to import; only recordings with gaps need it.

    table = observed.table
    use = np.isfinite(amplitude) & (amplitude > 0)
    if saturation is not None:
        use &= amplitude < saturation
    missing, frames = table.missing[use], table.frames[use]
    # Saturated pixels are missing for another reason.
    other = np.nan_to_num(amplitude) < (np.inf if saturation is None else saturation)
    total = table.frames[other].sum()
    plain = DropoutModel(
        base_share=float(table.missing[other].sum() / total) if total else 0.0,
        saturation_amplitude=saturation,
    )
    if not missing.sum():
        return plain
    at = np.log(amplitude[use])
    edges = np.unique(np.quantile(at, _levels(len(at))))
    place = np.clip(np.searchsorted(edges, at, side="right") - 1, 0, max(len(edges) - 2, 0))
    count = np.bincount(place, frames)
    lost = np.bincount(place, missing)
    centre = np.bincount(place, frames * at) / np.maximum(count, 1)
    base = float(missing.sum() / frames.sum())
    flat = _deviance(np.full(len(count), base), lost, count)
    best, at_best = flat, None
    for start in np.quantile(centre, (0.02, 0.1, 0.3)):
        found = minimize(
            lambda x: _deviance(_probability(x, centre), lost, count),
            np.array([_logit(base / 2), start, np.log(0.1)]),
            method="Nelder-Mead",
            options={"maxiter": 2000, "xatol": 1e-4, "fatol": 1e-3},
        )
        if found.fun < best:
            best, at_best = float(found.fun), found.x
    if at_best is None or flat - best < _LEAST_GAIN * max((observed.pose_missing > 0).sum(), 1):
        return plain
    base = float(0.5 * (1.0 + np.tanh(0.5 * at_best[0])))
    return DropoutModel(
        base_share=base if base * total >= 1 else 0.0,
        amplitude_at_half=float(np.exp(at_best[1])),
        width=float(np.clip(np.exp(at_best[2]), *_WIDTHS)),
        saturation_amplitude=saturation,
    )


def _levels(count: int) -> np.ndarray:
    """Return the quantiles of the amplitude that bins of this many pixels end at."""
    dark = np.geomspace(1.0 / count, 1.0 / _BINS, _DARK_BINS) if count > _BINS else np.empty(0)
    return np.union1d(np.linspace(0.0, 1.0, _BINS + 1), dark)


def _probability(x: np.ndarray, at: np.ndarray) -> np.ndarray:
    base = 0.5 * (1.0 + np.tanh(0.5 * x[0]))  # The logistic function, without overflow.
    width = np.clip(np.exp(x[2]), *_WIDTHS)
    dark = 1.0 / (1.0 + np.exp(np.clip((at - x[1]) / width, -50.0, 50.0)))
    return base + (1.0 - base) * dark


def _deviance(probability: np.ndarray, lost: np.ndarray, count: np.ndarray) -> float:
    """Return the negative log likelihood."""
    sure = np.clip(probability, 1e-9, 1.0 - 1e-9)
    return float(-(lost * np.log(sure) + (count - lost) * np.log1p(-sure)).sum())


def _logit(share: float) -> float:
    share = min(max(share, 1e-6), 1.0 - 1e-6)
    return float(np.log(share / (1.0 - share)))
