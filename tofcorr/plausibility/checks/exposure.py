"""Do the frames have one exposure, where none was recorded?"""

import numpy as np

from tofcorr.plausibility.finding import Finding, in_words
from tofcorr.plausibility.look import Look

# Fewest frames of a target, and of each exposure. Chosen.
_FEWEST, _FEWEST_OF_ONE = 10, 3
# Share of a frame's pixels that are brighter than its brightness. Chosen.
_BRIGHTEST = 0.1
# Least ratio of two exposures, and how many times the spread within them it is, as logarithms.
# Chosen: exposures differ by whole stops, and stood apart by 20 times the spread.
_RATIO, _CLEAR = 2.0, 8.0
# Least share of the frames at which the exposure is another one than that of the frame before.
# Chosen: of independent exposures half are; targets that only share a name come one after another.
_CHANGES = 0.25


def check(look: Look) -> list[Finding]:
    """Compare how bright each frame sees its target, distance and tilt taken off."""
    times = look.sample.column("integration_time")
    recorded = times is not None and np.isfinite(times).all() and np.ptp(times) > 0
    if look.sample.amplitude is None or recorded:
        return []
    level = _brightness(look)
    targets = look.sample.data.targets[look.sample.frames]
    for name in np.unique(targets):
        own = np.flatnonzero((targets == name) & np.isfinite(level))
        brighter = _two(level[own])
        if brighter is None:
            continue
        ratio = np.exp(level[own][brighter].mean() - level[own][~brighter].mean())
        frames = look.sample.frames[own[brighter]].tolist()
        return [
            Finding(
                "exposure",
                "doubtful",
                f"{in_words(frames).capitalize()} see {name} {ratio:.1f} times as bright as the "
                "others do: frames of two exposures, whose distances may differ; record "
                "integration_time_us, or train them apart.",
                tuple(frames),
            )
        ]
    return []


def _brightness(look: Look) -> np.ndarray:
    """Return the logarithm of how bright each frame is at 1 m and head on, shape (F,).

    That of its brightest tenth: nearly every view of a board shows a bright square.
    """
    amplitude, distance, own = look.sample.amplitude, look.distance, look.own
    assert amplitude is not None
    cosine = np.abs(np.einsum("fpa,fa->fp", look.rays, np.nan_to_num(own.normal)))
    used = own.on_plane & np.isfinite(distance) & np.isfinite(amplitude) & (cosine > 0)
    seen = np.where(used, amplitude * distance**2 / np.maximum(cosine, 1e-12), 0.0)
    brightest = np.sort(seen, axis=1)[:, ::-1]
    tenth = (_BRIGHTEST * used.sum(1)).astype(int)
    level = np.log(np.maximum(brightest[np.arange(len(seen)), tenth], 1e-300))
    return np.where(own.known & (tenth > 0), level, np.nan)


def _two(level: np.ndarray) -> np.ndarray | None:
    """Return which frames are the brighter ones; None where there are no two exposures."""
    if len(level) < _FEWEST:
        return None
    rising = np.sort(level)
    middle = int(np.argmax(np.diff(rising)))
    brighter = level > (rising[middle] + rising[middle + 1]) / 2
    if min(brighter.sum(), (~brighter).sum()) < _FEWEST_OF_ONE:
        return None
    apart = level[brighter].mean() - level[~brighter].mean()
    spread = np.sqrt((level[brighter].var() + level[~brighter].var()) / 2)
    if apart < max(np.log(_RATIO), _CLEAR * spread):
        return None
    return brighter if (brighter[1:] != brighter[:-1]).mean() >= _CHANGES else None
