r"""How far successive frames share their noise: a camera that averages frames filters in time.

A frame of such a camera is :math:`n_t = \rho n_{t-1} + \sqrt{1 - \rho^2}\, e_t`. Frames k apart
differ by :math:`\sigma^2 (1 - \rho^k)` in half squares, so that those of two steps are
:math:`1 + \rho` times those of one, whatever the noise is.
"""

import numpy as np

# Standard errors, over poses, that the correlation must exceed to be counted. Chosen: one camera in
# 700 without a filter gets one.
_LEAST_ERRORS = 3.0
# Largest correlation considered (no unit). Chosen: the variance of a frame is corrected by the
# inverse of what is left.
_MOST = 0.95


def frame_differences(residual: np.ndarray) -> tuple[float, float]:
    """Return half the mean square of differences of frames one and two apart, m^2.

    Args:
        residual: Frames of one pose, shape (R, H, W), metres; NaN where unknown.

    Returns:
        Both NaN with fewer than three frames, or without a pixel known in all of them.
    """
    known = np.isfinite(residual).all(0)
    if len(residual) < 3 or not known.any():
        return np.nan, np.nan
    values = residual[:, known]
    near, far = (np.mean((values[lag:] - values[:-lag]) ** 2) / 2 for lag in (1, 2))
    return float(near), float(far)


def correlation_of_frames(differences: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the correlation of successive frames, 0 if it is not significant, and each pose's.

    Args:
        differences: What `frame_differences` returned for each pose, shape (P, 2).

    Returns:
        From 0 to 0.95; and shape (P,), NaN where unknown.
    """
    near, far = differences.T
    with np.errstate(divide="ignore", invalid="ignore"):
        by_pose = np.where(near > 0, far / near - 1.0, np.nan)
    values = by_pose[np.isfinite(by_pose)]
    if len(values) < 3:
        return 0.0, by_pose
    error = values.std(ddof=1) / len(values) ** 0.5
    mean = float(values.mean())
    return (min(mean, _MOST) if mean > _LEAST_ERRORS * error else 0.0), by_pose


def shown_by_repeats(correlation: float, repeats: np.ndarray) -> np.ndarray:
    """Return which share of a frame's variance the variance over repeated frames shows.

    Args:
        correlation: Of successive frames.
        repeats: Numbers of frames, any shape, int.
    """
    most = int(repeats.max(initial=0))
    shown = [1.0 - mean_correlation(correlation, count) for count in range(most + 1)]
    return np.array(shown)[repeats]


def mean_correlation(correlation: float, count: int) -> float:
    """Return the mean correlation of all pairs among successive frames; 0 of less than two.

    Args:
        correlation: Of two successive frames; of k apart it is that to the power of k.
        count: Number of frames.
    """
    if count < 2:
        return 0.0
    lags = np.arange(1, count)
    return float(((count - lags) * correlation**lags).sum() / (count - lags).sum())
