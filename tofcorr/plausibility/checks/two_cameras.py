"""Is the pattern of the pixels the same in all frames?"""

import math

import numpy as np

from tofcorr.plausibility.finding import Finding
from tofcorr.plausibility.look import Look

# Fewest frames and pixels to tell two patterns apart. Chosen.
_FEWEST_FRAMES, _FEWEST_PIXELS = 16, 60
# Share of frames on which both halves of the pixels must agree, and the least share of frames that
# may come from another camera. Chosen.
_AGREE, _SMALLER = 0.95, 0.25
# Residuals are cut at so many robust standard deviations. Chosen.
_CUT = 3.0
# The groups' distance over their spread, at the least. Chosen: one normal cloud cut in two has 1.3.
_APART = 2.5
# Moments at which the pattern may have changed that are tried, at most. Chosen: a change is seen
# from any moment that is off by a fortieth of the frames.
_MOMENTS = 41
# Correlation of the change over the pixels between two halves of the frames, at the least. In 12
# recordings of two cameras it was 0.76 to 0.84, in 51 clean ones at most 0.32 (simulators `demo`,
# all shipped ones, and drawn ones). With few pixels chance makes more: so many times 1 / sqrt(P).
_CORRELATED, _BY_CHANCE = 0.55, 5.0
# Least change of a pixel, metres, root mean square. Chosen: the patterns of two cameras differ by
# more, and a smaller one moves no plane.
_LEAST_CHANGE = 1e-3


def check(look: Look) -> list[Finding]:
    """Look for a moment at which the pattern changed, then for two patterns in any order."""
    chosen = _one_of_each_pose(look)
    pattern = _patterns(look, chosen)
    if pattern is None:
        return []
    moment = _moment(pattern)
    if moment is not None:
        return [_finding(look.sample.frames[chosen[moment:]], len(chosen))]
    return _two_groups(look, chosen, pattern)


def _moment(pattern: np.ndarray) -> int | None:
    """Return the frame at which the pattern changed for good; None: it did not.

    The change is measured twice, by even and by odd frames. Their noise is independent: what both
    see in the same pixels is a change.
    """
    number, pixels = pattern.shape
    fewest = max(_FEWEST_FRAMES // 2, math.ceil(_SMALLER * number))
    best, found = max(_CORRELATED, _BY_CHANCE / math.sqrt(pixels)), None
    moments = np.linspace(fewest, number - fewest, _MOMENTS).astype(int)
    for moment in np.unique(moments) if number >= 2 * fewest else ():
        one, other = (
            pattern[moment:][half::2].mean(0) - pattern[:moment][half::2].mean(0) for half in (0, 1)
        )
        both = float(one @ other)
        correlation = both / max(math.sqrt(float((one @ one) * (other @ other))), 1e-300)
        if correlation > best and both > pixels * _LEAST_CHANGE**2:
            best, found = correlation, int(moment)
    return found


def _two_groups(look: Look, chosen: np.ndarray, pattern: np.ndarray) -> list[Finding]:
    """Divide the frames in two by what half of the pixels say; the other half must agree."""
    first, second = (_groups(pattern[:, half::2]) for half in (0, 1))
    if first is None or second is None:
        return []
    agree = float((first == second).mean())
    agree = max(agree, 1 - agree)
    smaller = min(first.mean(), 1 - first.mean())
    if agree < _AGREE or smaller < _SMALLER:
        return []
    return [_finding(look.sample.frames[chosen[first == first[-1]]], len(first))]


def _finding(group: np.ndarray, number: int) -> Finding:
    return Finding(
        "two cameras",
        "doubtful",
        f"The pattern of the pixels' errors is another one in {len(group)} of {number} frames, "
        f"from frame {int(group.min())} on: frames of two cameras, or of two settings of one; "
        "train them apart.",
        spoils=True,
    )


def _one_of_each_pose(look: Look) -> np.ndarray:
    """Return indices of frames of distinct poses: repeats of one show the same, whatever it is."""
    poses = np.asarray(look.sample.column("world_from_tool")).reshape(len(look.usable), -1)
    if not look.sample.data.moves:
        return np.flatnonzero(look.usable)
    first = np.unique(np.round(poses, 5), axis=0, return_index=True)[1]
    return np.sort(first[look.usable[first]])


def _patterns(look: Look, chosen: np.ndarray) -> np.ndarray | None:
    """Return the frames' residuals to their own planes without smooth parts, shape (F, P)."""
    pixel = look.sample.pixel[chosen]
    same = (pixel == pixel[:1]).all() if len(pixel) else False
    residual = look.own.off_by[chosen]
    complete = np.isfinite(residual).mean(0) > 0.9
    if not same or len(residual) < _FEWEST_FRAMES or complete.sum() < _FEWEST_PIXELS:
        return None
    residual = residual[:, complete]
    residual[np.isnan(residual).all(1)] = 0.0  # A frame without a plane says nothing.
    rays = look.rays[chosen[0], complete]
    x, y = rays[:, 0] / rays[:, 2], rays[:, 1] / rays[:, 2]
    smooth = np.stack([x**i * y**j for i in range(4) for j in range(4 - i)], axis=1)
    spread = 1.4826 * np.nanmedian(np.abs(residual), axis=1, keepdims=True)
    cut = np.nan_to_num(np.clip(residual, -_CUT * spread, _CUT * spread))
    basis = np.linalg.qr(smooth)[0]
    return cut - (cut @ basis) @ basis.T


def _groups(pattern: np.ndarray) -> np.ndarray | None:
    """Return which of two groups each frame is in, shape (F,), bool; None if there is one."""
    centred = pattern - pattern.mean(0)
    direction = np.linalg.svd(centred, full_matrices=False)[2][0]
    score = centred @ direction
    high = score > np.median(score)
    for _ in range(20):
        if high.all() or not high.any():
            return None
        middle = (score[high].mean() + score[~high].mean()) / 2
        high = score > middle
    if high.all() or not high.any():
        return None
    spread = np.sqrt((score[high].var() + score[~high].var()) / 2)
    apart = score[high].mean() - score[~high].mean()
    return high if apart > _APART * max(2 * spread, 1e-12) else None
