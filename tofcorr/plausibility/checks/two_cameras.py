"""Is the pattern of the pixels the same in all frames?"""

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


def check(look: Look) -> list[Finding]:
    """Divide the frames in two by what half of the pixels say; the other half must agree."""
    chosen = _one_of_each_pose(look)
    pattern = _patterns(look, chosen)
    if pattern is None:
        return []
    first, second = (_groups(pattern[:, half::2]) for half in (0, 1))
    if first is None or second is None:
        return []
    agree = float((first == second).mean())
    agree = max(agree, 1 - agree)
    smaller = min(first.mean(), 1 - first.mean())
    if agree < _AGREE or smaller < _SMALLER:
        return []
    group = look.sample.frames[chosen[first == first[-1]]]
    return [
        Finding(
            "two cameras",
            "doubtful",
            f"The pattern of the pixels' errors is another one in {len(group)} of "
            f"{len(first)} frames, from frame {int(group.min())} on: frames of two cameras, or of "
            "two settings of one; train them apart.",
            spoils=True,
        )
    ]


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
