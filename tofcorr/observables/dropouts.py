"""Measures how many pixels have no distance or are saturated, where, and at which amplitude."""

from dataclasses import dataclass

import numpy as np

from tofcorr.estimation.noise import ArrayT
from tofcorr.observables.read import Observed, quotient
from tofcorr.options import Options, PositiveNumber, Share

# Bins of ln amplitude that the model is fitted to: of equal count, and finer ones of the darkest
# pixels, of which a camera may lose only a few. Set by hand: finer than any transition width.
_BINS, _DARK_BINS = 200, 40
# Narrowest and widest transition, in ln amplitude. A sharper one is a step in every camera.
_WIDTHS = (0.01, 2.0)


class DropoutModel(Options):
    """The probability that a pixel gives no distance.

    Attributes:
        base_share: b, missing at any amplitude.
        amplitude_at_half: A_1/2, counts; null: the amplitude plays no part, or is not recorded.
        width: w, of the transition in ln A: from 73 % to 27 % missing within two widths.
        saturation_amplitude: The largest amplitude that the camera states, counts; a pixel that
            reaches it is not valid. Null: unknown.
        saturated_share: Share of those pixels that have no distance; null: as darker ones.
    """

    base_share: Share = 0.0
    amplitude_at_half: PositiveNumber | None = None
    width: PositiveNumber = 0.1
    saturation_amplitude: PositiveNumber | None = None
    saturated_share: Share | None = None

    @property
    def needs_amplitude(self) -> bool:
        """Whether anything depends on the amplitude."""
        return not (self.amplitude_at_half is self.saturation_amplitude is None)

    def probability(self, amplitude: ArrayT) -> ArrayT:
        """Return the probability that pixels of these amplitudes are missing; same shape.

        Saturated pixels count as others here, unless `saturated_share` is known.
        """
        share = amplitude * 0.0 + self.base_share
        if self.amplitude_at_half is not None:
            # No power of the share of the threshold overflows: e^-80 is nothing, e^80 a float32.
            brightest = np.exp(80 * self.width)
            relative = (amplitude / self.amplitude_at_half).clip(min=1e-6, max=brightest)
            share = share + (1.0 - self.base_share) / (1.0 + relative ** (1.0 / self.width))
        if self.saturated_share is not None:
            saturated = self.saturated(amplitude)
            share = share * ~saturated + self.saturated_share * saturated
        return share

    def saturated(self, amplitude: ArrayT) -> ArrayT:
        """Return where pixels are saturated, bool, same shape."""
        level = self.saturation_amplitude
        return amplitude >= (np.inf if level is None else level)


@dataclass(frozen=True, kw_only=True, eq=False)
class DropoutMeasurement:
    """Missing and saturated pixels of a recording, among those on the target.

    Attributes:
        model: The probability that a pixel is missing.
        share: Share without a distance.
        saturated_share: Share at or above the saturation amplitude.
        saturated_missing: Share that is saturated and has no distance.
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
    map: np.ndarray
    border_share: float
    centre_share: float
    amplitude: np.ndarray
    amplitude_recorded: bool
    observed: Observed


def dropouts_of(observed: Observed) -> DropoutMeasurement:
    """Measure the missing and saturated pixels of a recording that was read.

    Without a mask, every pixel counts as on the target.
    """
    amplitude, recorded = _amplitude_everywhere(observed)
    saturation, stated = _saturation(observed, amplitude)
    table, pixels = observed.table, max(observed.map_frames.sum(), 1)
    model = _fitted(observed, amplitude, saturation)
    beyond = model.saturated(amplitude)
    saturated = observed.saturated / pixels
    if not stated:
        saturated = table.frames[beyond].sum() / max(table.frames.sum(), 1)
    border = border_of(observed.map_frames.shape)
    border_share, centre_share = (
        float(observed.map_missing[where].sum() / max(observed.map_frames[where].sum(), 1))
        for where in (border, ~border)
    )
    return DropoutMeasurement(
        model=model,
        share=float(observed.map_missing.sum() / pixels),
        saturated_share=float(saturated),
        saturated_missing=float(table.missing[beyond].sum() / max(table.frames.sum(), 1)),
        map=quotient(observed.map_missing, observed.map_frames),
        border_share=border_share,
        centre_share=centre_share,
        amplitude=amplitude,
        amplitude_recorded=recorded,
        observed=observed,
    )


def border_of(shape: tuple[int, ...]) -> np.ndarray:
    """Return True in the outer eighth of an image (H, W) on each side, bool."""
    height, width = shape
    border = np.ones((height, width), dtype=bool)
    border[height // 8 : height - height // 8, width // 8 : width - width // 8] = False
    return border


def _saturation(observed: Observed, amplitude: np.ndarray) -> tuple[float | None, bool]:
    """Return the saturation amplitude, and whether the recording states it.

    If not, it is where many pixels share the largest amplitude: random ones hardly ever agree.
    """
    if observed.recording.saturation_amplitude is not None:
        return observed.recording.saturation_amplitude, True
    known = amplitude[np.isfinite(amplitude)]
    piled = int((known == known.max()).sum()) if len(known) else 0
    return (float(known.max()) if piled >= max(20, len(known) / 10_000) else None), False


def _fitted(observed: Observed, amplitude: np.ndarray, saturation: float | None) -> DropoutModel:
    """Fit the model by maximum likelihood."""
    from scipy.optimize import minimize  # Slow to import; only recordings with gaps need them.
    from scipy.special import expit, logit

    table, plain = observed.table, DropoutModel(saturation_amplitude=saturation)
    other = ~plain.saturated(amplitude)  # Saturated pixels are missing for another reason.
    total = table.frames[other].sum()
    share = float(table.missing[other].sum() / max(total, 1))
    plain = plain.model_copy(update={"base_share": share})
    use = other & (np.nan_to_num(amplitude) > 0)
    missing, frames, at = table.missing[use], table.frames[use], np.log(amplitude[use])
    if not missing.sum():
        return plain
    levels = np.linspace(0.0, 1.0, _BINS + 1)
    if len(at) > _BINS:
        levels = np.union1d(levels, np.geomspace(1.0 / len(at), 1.0 / _BINS, _DARK_BINS))
    edges = np.unique(np.quantile(at, levels))
    place = np.clip(np.searchsorted(edges, at, side="right") - 1, 0, max(len(edges) - 2, 0))
    count, lost, sums = (np.bincount(place, each) for each in (frames, missing, frames * at))
    centre = sums / np.maximum(count, 1)

    def model(x: np.ndarray) -> DropoutModel:
        """Return the model of the logit of the base, ln threshold and ln width."""
        base, width = float(expit(x[0])), float(np.exp(x[2]).clip(*_WIDTHS))
        changes = {"base_share": base, "amplitude_at_half": float(np.exp(x[1])), "width": width}
        return plain.model_copy(update=changes)

    def unlikely(probability: np.ndarray | float) -> float:
        """Return the negative log likelihood."""
        sure = np.clip(probability, np.finfo(float).eps, 1.0 - np.finfo(float).eps)
        return float(-(lost * np.log(sure) + (count - lost) * np.log1p(-sure)).sum())

    base = missing.sum() / frames.sum()
    tried = [
        minimize(
            lambda x: unlikely(model(x).probability(np.exp(centre))),
            np.array([logit(np.clip(base / 2, 1e-6, 1.0)), start, np.log(0.1)]),
            method="Nelder-Mead",
        )
        for start in np.quantile(centre, (0.02, 0.1, 0.3))
    ]
    best = min(tried, key=lambda found: found.fun)
    # Half the 95 % quantile of chi-square with two degrees of freedom, for each pose with any.
    if unlikely(base) - best.fun < 3 * max(observed.losing_poses, 1):
        return plain
    found = model(best.x)
    return found if found.base_share * total >= 1 else found.model_copy(update={"base_share": 0.0})


def _amplitude_everywhere(observed: Observed) -> tuple[np.ndarray, bool]:
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
    if not lost.any() or positive.mean() >= 0.5:
        return raw, True
    estimated = _light_law(observed)
    known = np.isfinite(table.amplitude) & ~lost
    return np.where(known, table.amplitude, estimated), False


def _light_law(observed: Observed) -> np.ndarray:
    """Return the amplitude that the law of light predicts for each row, counts."""
    table, (height, width) = observed.table, observed.map_frames.shape
    row, column = table.pixel // width, table.pixel % width
    radius = np.hypot(row - (height - 1) / 2, column - (width - 1) / 2) / np.hypot(height, width)
    columns = [radius**power for power in (0, 2, 4)]
    columns += [(table.target == number) * 1.0 for number in np.unique(table.target)[1:]]
    design = np.stack(columns, axis=1)
    signal = np.log(np.where(table.signal > 0, table.signal, np.nan))
    known = np.isfinite(signal) & np.isfinite(table.amplitude) & (table.amplitude > 0)
    if known.sum() < design.shape[1]:
        return np.full(len(table), np.nan)
    wanted = np.log(table.amplitude[known]) - signal[known]
    solution = np.linalg.lstsq(design[known], wanted, rcond=None)[0]
    return np.exp(signal + design @ solution)
