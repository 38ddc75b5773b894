"""Does an image stand in the recording twice?"""

import numpy as np

from tofcorr.plausibility.finding import Finding, in_words
from tofcorr.plausibility.look import Look

# Fewest distinct values of an image for equality to mean anything. Chosen: by chance, as many
# noisy pixels never agree.
_FEWEST_VALUES = 12
# Share of the frames that are copies from which a fit is meaningless. Chosen.
_MANY = 0.5


def check(look: Look) -> list[Finding]:
    """Compare all images bit by bit on a fixed grid."""
    grid = look.sample.grid
    first: dict[bytes, int] = {}
    copies: list[int] = []
    for k, image in enumerate(grid):
        values = image[np.isfinite(image) & (image > 0)]
        if len(np.unique(values)) < _FEWEST_VALUES:
            continue
        if first.setdefault(image.tobytes(), k) != k:
            copies.append(k)
    if not copies:
        return []
    frames = tuple(look.sample.frames[copies].tolist())
    poses = np.asarray(look.sample.column("world_from_tool"))
    moved = [k for k in copies if np.abs(poses[k] - poses[first[grid[k].tobytes()]]).max() > 1e-4]
    many = len(copies) > _MANY * len(grid) and look.fits
    what = f"The depth of {in_words(frames)} repeats an earlier frame bit by bit"
    if moved:
        sentence = f"{what}, with another pose: the camera hung or images were paired wrongly"
    else:
        sentence = f"{what}: the frames were written twice"
    return [
        Finding(
            "duplicates",
            "impossible" if many and moved else "doubtful",
            f"{sentence}; remove them.",
            frames,
        )
    ]
