"""Small tiles of an image, in which pixels share structure whatever its shape."""

from torch import Tensor

from tofcorr.diagnosis.sums.observations import Observations

# Mean number of pixels in a tile. Chosen: enough pairs, yet smaller than the patterns of effects.
_PER_TILE = 12.0


def small_tiles(observations: Observations) -> dict[str, Tensor]:
    """Return the tile of every pixel, (M,), int64, for squares, pieces of rows and of columns."""
    camera = observations.recording.camera
    pixel = observations.pixel
    row, column = pixel // camera.width, pixel % camera.width
    density = len(pixel) / (observations.num_frames * camera.height * camera.width)
    if observations.recording.mask is not None:
        seen = float(observations.on_target.double().mean())
        density = density / max(seen, 1e-6)
    area = _PER_TILE / min(max(density, 1e-6), 1.0)
    side = max(2, round(area**0.5))
    length = max(2, round(area))
    return {
        "squares": row // side * camera.width + column // side,
        "rows": row * camera.width + column // length,
        "columns": row // length * camera.width + column,
    }
