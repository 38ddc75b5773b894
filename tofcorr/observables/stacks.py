"""Statistics of stacks of images (R, H, W) in which pixels are missing, as NaN."""

import numpy as np

from tofcorr.spread import sigma_from_mad

# Deviations beyond this many robust standard deviations of pixels of their brightness are clipped:
# mixed pixels at edges are no noise. As in the noise floor of a diagnosis.
_CLIP = 6.0
# Groups of brightness in a pose for that. Chosen: noise differs little within an eighth of the
# pixels, and an image of 32 x 25 pixels still has 100 in each.
_CLIP_GROUPS = 8
# Standard deviation of a group that repeats exactly, metres: its weight must be finite. Chosen: the
# rounding of float32 depth.
_LEAST_SPREAD = 1e-7


def clipped(residual: np.ndarray, amplitude: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """Clip residuals (R, H, W) at six robust standard deviations of pixels of their brightness.

    Returns:
        The clipped residuals, and the weights (H, W) that those standard deviations give, 1/m^2.
    """
    known = np.flatnonzero(np.isfinite(residual))
    values = residual.ravel()[known]
    order = np.arange(len(known))
    if amplitude is not None:
        order = np.argsort(amplitude.ravel()[known], kind="stable")
    spread = np.full(len(known), np.inf)
    for part in np.array_split(order, _CLIP_GROUPS):
        if len(part):
            around = np.abs(values[part] - np.median(values[part]))
            spread[part] = sigma_from_mad(float(np.median(around))) or np.inf
    clipped, weight = np.full((2, residual.size), np.nan)
    clipped[known] = np.clip(values, -_CLIP * spread, _CLIP * spread)
    weight[known] = 1.0 / np.where(np.isfinite(spread), spread, _LEAST_SPREAD) ** 2
    weight = known_mean(weight.reshape(residual.shape))
    return clipped.reshape(residual.shape), np.nan_to_num(weight)


def known_mean(images: np.ndarray) -> np.ndarray:
    """Return the mean of the known values of (R, H, W); NaN where there is none."""
    known = np.isfinite(images)
    return np.divide(
        np.where(known, images, 0.0).sum(0),
        known.sum(0),
        out=np.full(images.shape[1:], np.nan),
        where=known.any(0),
    )


def known_variance(values: np.ndarray) -> np.ndarray:
    """Return the unbiased variance of the known values of each column of (R, M); NaN below two."""
    known = np.isfinite(values)
    count = known.sum(0)
    around = np.where(known, values - known_mean(values[:, None])[0], 0.0)
    return np.where(count > 1, (around**2).sum(0) / np.maximum(count - 1, 1), np.nan)


def repeated_variance(residual: np.ndarray) -> float:
    """Return the variance within the mean image of a pose, less that of its noise, m^2."""
    known = np.isfinite(residual).all(0)
    if len(residual) < 2 or not known.any():
        return np.nan
    values = residual[:, known]
    noise = float(values.var(0, ddof=1).mean())
    return float(np.mean(values.mean(0) ** 2)) - noise / len(values)
