"""A thinned sample of a recording's pixels: enough to judge it, and read in a moment."""

from dataclasses import dataclass

import numpy as np

from tofcorr.data.header import DepthKind
from tofcorr.data.recording import Recording
from tofcorr.pixels.dataset import Dataset
from tofcorr.spread import sigma_from_mad

# Pixels looked at in all, and the limits for one frame. Chosen: a plane is then known to a tenth of
# the noise of one pixel, and 60 frames are read and judged in well below 0.3 s.
_ALL_PIXELS = 12_000
_MOST, _LEAST = 200, 24
# Frames looked at; of a longer recording as many, evenly spaced. Chosen: as many as twenty minutes
# of poses, judged in about a second.
_MOST_FRAMES = 600
# Second difference of neighbours from which one of them is garbage, metres. Chosen.
_JUMP = 0.15
# Points across and down a fixed grid of each image, whether masked or not. Chosen.
_GRID = 12


@dataclass(frozen=True, eq=False)
class Sample:
    """Some pixels of each frame, and the frames' rows.

    F frames, P pixels of each, G pixels of a fixed grid.

    Attributes:
        data: The recordings.
        frames: Global numbers of the frames looked at, shape (F,).
        pixel: Flat index of each pixel in its image, shape (F, P).
        stored: Depth as stored, shape (F, P), float64, metres; NaN: not usable, or no pixel.
        amplitude: Shape (F, P); None if not recorded.
        grid: Depth as stored on the fixed grid, whatever the mask says, shape (F, G), float32.
        grid_pixel: Flat indices of that grid, shape (G,).
        masked: Share of each image's pixels on the target by the mask, shape (F,); 1 without one.
        off_mask: As `stored`, but pixels off the mask, shape (F, P'); None without a mask.
        off_pixel: Flat indices of these, shape (F, P').
        noise: Standard deviation of one pixel along its ray, metres, from how far pixels are off
            the line through their neighbours in a row; NaN where no three neighbours are valid.
        noise_rms: The same as a root mean square, which noisy pixels raise.
    """

    data: Dataset
    frames: np.ndarray
    pixel: np.ndarray
    stored: np.ndarray
    amplitude: np.ndarray | None
    grid: np.ndarray
    grid_pixel: np.ndarray
    masked: np.ndarray
    off_mask: np.ndarray | None
    off_pixel: np.ndarray | None
    noise: float
    noise_rms: float

    @property
    def recording(self) -> Recording:
        """The first recording, which stands for the camera."""
        return self.data.first

    @property
    def rays(self) -> np.ndarray:
        """Unit rays of all pixels of the image, shape (H, W, 3)."""
        return self.data.ray_directions().numpy()

    def column(self, name: str) -> np.ndarray | None:
        """Return a column of the frames' tables for the frames looked at; None if one lacks it."""
        parts = [getattr(one.frames, name) for one in self.data.recordings]
        if any(part is None for part in parts):
            return None
        return np.concatenate(parts)[self.frames]


def read_sample(data: Dataset) -> Sample:
    """Read a few pixels of each frame, evenly spread over the pixels on the target."""
    total = data.num_frames
    frames = np.unique(np.linspace(0, total - 1, min(total, _MOST_FRAMES)).astype(int))
    camera = data.first.camera
    size = camera.height * camera.width
    number = int(np.clip(_ALL_PIXELS // len(frames), _LEAST, _MOST))
    everywhere = _even(np.arange(size), number, camera.width)
    rows = np.unique(np.linspace(0, camera.height - 1, _GRID).astype(int))
    columns = np.unique(np.linspace(0, camera.width - 1, _GRID).astype(int))
    grid_pixel = (rows[:, None] * camera.width + columns).ravel()
    rays = data.ray_directions().numpy().reshape(-1, 3)
    parts = [
        _read_frame(recording, int(k), everywhere, grid_pixel, number, rays)
        for recording, _, local in data.by_recording(frames)
        for k in local
    ]
    masked = any(recording.mask is not None for recording in data.recordings)
    pixel, stored, amplitude, grid, share, off, off_pixel, differences = zip(*parts, strict=True)
    known = [one for one in amplitude if one is not None]
    second = np.concatenate(differences)
    second = second[np.abs(second) < _JUMP]
    return Sample(
        data=data,
        frames=frames,
        pixel=_padded(pixel, 0).astype(int),
        stored=_padded(stored, np.nan),
        amplitude=_padded(known, np.nan) if len(known) == len(parts) else None,
        grid=np.stack(grid),
        grid_pixel=grid_pixel,
        masked=np.array(share),
        off_mask=_padded(off, np.nan) if masked else None,
        off_pixel=_padded(off_pixel, 0).astype(int) if masked else None,
        # A second difference of independent values has six times their variance.
        noise=sigma_from_mad(float(np.median(np.abs(second)))) / 6**0.5 if len(second) else np.nan,
        noise_rms=float(np.sqrt(np.mean(second**2) / 6)) if len(second) else np.nan,
    )


def _read_frame(
    recording: Recording,
    k: int,
    everywhere: np.ndarray,
    grid_pixel: np.ndarray,
    number: int,
    rays: np.ndarray,
) -> tuple[
    np.ndarray,
    np.ndarray,
    np.ndarray | None,
    np.ndarray,
    float,
    np.ndarray,
    np.ndarray,
    np.ndarray,
]:
    """Return pixels, depth, amplitude, grid, share of the mask, what is off it, differences."""
    image = recording.depth[k].reshape(-1)
    width = recording.camera.width
    pixel, off, share = everywhere, np.zeros(0, dtype=int), 1.0
    if recording.mask is not None:
        inside = np.flatnonzero(recording.mask[k].reshape(-1))
        share = len(inside) / len(image)
        pixel = _even(inside, number, width)
        outside = np.setdiff1d(everywhere, inside, assume_unique=True)
        off = outside
    amplitude = None
    if recording.amplitude is not None:
        amplitude = np.asarray(recording.amplitude[k].reshape(-1)[pixel], dtype=np.float64)
    stored = _depth_at(image, pixel)
    if amplitude is not None and recording.saturation_amplitude is not None:
        stored[amplitude >= recording.saturation_amplitude] = np.nan
    column = pixel % width
    within = (column > 0) & (column < width - 1)
    differences = _off_neighbours(image, pixel[within], rays, recording.depth_kind)
    grid = np.array(image[grid_pixel])
    return pixel, stored, amplitude, grid, share, _depth_at(image, off), off, differences


def _off_neighbours(
    image: np.ndarray, middle: np.ndarray, rays: np.ndarray, kind: DepthKind
) -> np.ndarray:
    """Return twice the distance of pixels from the straight line through their neighbours, metres.

    A plane leaves nothing, however wide the pixels are and however it is tilted. Between narrow
    pixels this is the second difference of the distances. Along a ray r = a p + b q, the line
    through the neighbours' points on p and q lies at 1 / (a / distance_p + b / distance_q).
    """
    p, r, q = (rays[middle + step] for step in (-1, 0, 1))
    at_p, at_r, at_q = (
        _depth_at(image, middle + step) / (ray[:, 2] if kind == "z" else 1.0)
        for step, ray in ((-1, p), (0, r), (1, q))
    )
    between = (p * q).sum(1)
    along_p, along_q = (p * r).sum(1), (q * r).sum(1)
    scale = 1 - between**2
    a, b = (along_p - between * along_q) / scale, (along_q - between * along_p) / scale
    return 2 * (1 / (a / at_p + b / at_q) - at_r)


def _depth_at(image: np.ndarray, pixel: np.ndarray) -> np.ndarray:
    depth = np.asarray(image[pixel], dtype=np.float64)
    return np.where(np.isfinite(depth) & (depth > 0), depth, np.nan)


def _even(pixels: np.ndarray, number: int, width: int) -> np.ndarray:
    """Return about `number` of some pixels, spread over rows and columns without a period."""
    if len(pixels) <= number:
        return pixels
    step = len(pixels) / number
    # Steps that the width divides would take the same columns of every row.
    if width > 1 and abs(step / width - round(step / width)) < 0.5 / number:
        step *= 1 - 1.5 / width
    chosen = np.unique((np.arange(0, len(pixels) / step) * step).astype(int))
    return pixels[chosen[chosen < len(pixels)]]


def _padded(parts: tuple[np.ndarray, ...] | list[np.ndarray], filling: float) -> np.ndarray:
    longest = max((len(part) for part in parts), default=0)
    joined = np.full((len(parts), max(longest, 1)), filling, dtype=np.float64)
    for row, part in zip(joined, parts, strict=True):
        row[: len(part)] = part
    return joined
