"""Images of errors before and after, in colours: blue too near, red too far, grey not used."""

from collections.abc import Mapping, Sequence

import numpy as np

# Share of the pixels within the colour scale. Set by hand.
_COLOURED = 0.98
# Least width of a picture, pixels: smaller images are enlarged by a whole factor. Set by hand.
_LEAST_WIDTH = 600
# Colours from too near to too far, of 255, in equal steps. The diverging scale of ColorBrewer
# (RdBu).
_SCALE = np.array(
    [(33, 102, 172), (146, 197, 222), (247, 247, 247), (244, 165, 130), (178, 24, 43)]
)
# Grey level of pixels that are not used, of 255. Chosen: no colour of the scale.
_NOT_USED = 190


def stacked(images: Sequence[np.ndarray]) -> np.ndarray:
    """Return images (H, W) below one another, with a gap of NaN between them."""
    free = np.full((gap_rows(images[0].shape[0]), images[0].shape[1]), np.nan)
    parts = [part for image in images for part in (image, free)]
    return np.concatenate(parts[:-1])


def gap_rows(height: int) -> int:
    """Return the rows left free between two frames, pixels."""
    return max(height // 25, 1)


def colour_limit(images: Sequence[np.ndarray]) -> float:
    """Return the limit of a colour scale, mm, that all but the most extreme pixels lie within."""
    values = np.abs(np.concatenate([image[np.isfinite(image)] for image in images]))
    return float(np.quantile(values, _COLOURED)) or 1.0 if values.size else 1.0


def coloured(image: np.ndarray, limit: float) -> np.ndarray:
    """Return an image of errors (H, W) in colours, shape (H, W, 3), uint8; NaN is grey."""
    place = (np.clip(image / limit, -1, 1) + 1) / 2 * (len(_SCALE) - 1)
    known, steps = np.isfinite(image), np.arange(len(_SCALE))
    channels = [np.interp(np.where(known, place, 0.0), steps, one) for one in _SCALE.T]
    shown = np.where(known[..., None], np.stack(channels, axis=-1), _NOT_USED)
    return shown.round().astype(np.uint8)


def error_picture(
    images: Sequence[Mapping[str, np.ndarray]], titles: Sequence[str]
) -> tuple[np.ndarray, str]:
    """Return errors before, after, and after once more on a finer scale, and what it shows.

    Args:
        images: For each frame `before` and `after`, shape (H, W), mm; NaN where not used.
        titles: One a frame.

    Returns:
        One row a frame, (H, W, 3), uint8; and the words, in Markdown.
    """
    common = colour_limit([one["before"] for one in images])
    own = colour_limit([one["after"] for one in images])
    columns = [
        coloured(stacked([one[stage] for one in images]), limit)
        for stage, limit in (("before", common), ("after", common), ("after", own))
    ]
    free = np.full((len(columns[0]), gap_rows(columns[0].shape[1]), 3), 255, dtype=np.uint8)
    picture = np.concatenate([columns[0], free, columns[1], free, columns[2]], axis=1)
    factor = -(-_LEAST_WIDTH // picture.shape[1])
    rows = "\n".join(f"{n}. {title.replace(chr(10), ', ')}" for n, title in enumerate(titles, 1))
    words = (
        f"Errors along the ray: blue too near, red too far, grey not used. Left: before, up to "
        f"{common:.1f} mm. Middle: after, the same scale. Right: after, up to {own:.2f} mm. "
        f"From top to bottom:\n\n{rows}"
    )
    return picture.repeat(factor, axis=0).repeat(factor, axis=1), words
