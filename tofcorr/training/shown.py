"""What figures of a calibration show: profiles of errors, and frames, as numbers and colours."""

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch

from tofcorr.correction.model import CalibrationModel
from tofcorr.data.frames import FrameBatch
from tofcorr.geometry.planes import tangents
from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.metrics import frame_errors
from tofcorr.pixels.sample import errors_along_ray, thinned
from tofcorr.training.calibration import Calibration

# Bins of a covariate. Set by hand.
_BINS = 30
# Bins of fewer pixels are left out: their mean is mostly noise. Set by hand.
_FEWEST_PIXELS = 30
# Share of a covariate's values left out at either end of the axis. Set by hand.
_ENDS = 0.001


class Profile(NamedTuple):
    """Middle of each bin, and mean and standard deviation of the errors in it, (bins,) each."""

    middle: np.ndarray
    mean: np.ndarray
    spread: np.ndarray


def profile(x: np.ndarray, error: np.ndarray, ends: tuple[float, float] | None = None) -> Profile:
    """Return mean and standard deviation of an error over a covariate.

    Args:
        x: The covariate, shape (M,).
        error: The error of each pixel, shape (M,); NaN is left out.
        ends: Range of the covariate; its central 99.8 % if None.
    """
    edges = np.linspace(*(ends or ends_of(x)), _BINS + 1)
    number = np.digitize(x, edges) - 1
    inside = (number >= 0) & (number < len(edges) - 1) & np.isfinite(error)
    count, total, square = (
        np.bincount(number[inside], weights, len(edges) - 1)
        for weights in (None, error[inside], error[inside] ** 2)
    )
    enough = count >= _FEWEST_PIXELS
    mean = total[enough] / count[enough]
    spread = np.sqrt(np.maximum(square[enough] / count[enough] - mean**2, 0))
    return Profile(((edges[1:] + edges[:-1]) / 2)[enough], mean, spread)


def ends_of(x: np.ndarray) -> tuple[float, float]:
    """Return the range of the central 99.8 % of a covariate."""
    low, high = np.quantile(x, [_ENDS, 1 - _ENDS])
    return float(low), float(high)


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


# How many frames are shown. Set by hand: as many as fit on a page.
_FRAMES_SHOWN = 5
# About how many pixels are measured to choose the frames shown; bounds the time on long
# recordings. Set by hand.
_PIXELS_RANKED = 3_000_000
# About how many points of one frame are drawn. Set by hand.
_POINTS_SHOWN = 4000


def frames_to_show(calibration: Calibration) -> np.ndarray:
    """Return global numbers of frames from the best corrected to the worst, at regular ranks."""
    data = calibration.data
    camera = data.first.camera
    most = max(_PIXELS_RANKED // (camera.height * camera.width), _FRAMES_SHOWN)
    frames = np.sort(np.concatenate([calibration.train, calibration.test]))
    ranked = thinned(frames, most)
    errors = frame_errors(data, {"after": calibration.stages["after"]}, ranked)["after"]
    used = errors.count > 0
    order = np.argsort(errors.squared[used] / errors.count[used])
    return thinned(errors.frames[used][order], _FRAMES_SHOWN)


def error_images(
    calibration: Calibration, frames: np.ndarray
) -> tuple[list[dict[str, np.ndarray]], list[str]]:
    """Return each frame's errors `before` and `after` along the ray, (H, W), mm, and its title.

    Args:
        calibration: The fitted model.
        frames: Global numbers.
    """
    data, images, titles = calibration.data, [], []
    for batch in _one_by_one(data, frames):
        frame = int(batch.indices[0])
        images.append(
            {
                stage: errors_along_ray(data, calibration.stages[stage], batch)[0][0].numpy()
                for stage in ("before", "after")
            }
        )
        half = "held out" if frame in calibration.test else "fitted"
        titles.append(f"frame {frame}, {data.targets[frame]}\n{half}")
    return images, titles


def points_on_plane(calibration: Calibration, frame: int) -> tuple[dict[str, np.ndarray], str]:
    """Return one frame's points on its plane at each stage, and a title.

    Args:
        calibration: The fitted model.
        frame: Global number of the frame.

    Returns:
        For each stage, shape (M, 3): two coordinates within the plane, metres, and the distance
        to the plane, millimetres.
    """
    data = calibration.data
    batch = next(_one_by_one(data, np.array([frame])))
    clouds = {name: _cloud(data, model, batch) for name, model in calibration.stages.items()}
    return clouds, f"Frame {frame}, {data.targets[frame]}: points and plane, height stretched"


def _one_by_one(data: Dataset, frames: np.ndarray) -> Iterator[FrameBatch]:
    """Yield batches of one frame each, in the order given."""
    for frame in frames:
        yield from data.batches(np.array([frame]))


def _cloud(data: Dataset, model: CalibrationModel, batch: FrameBatch) -> np.ndarray:
    """Return coordinates within the plane (m) and the distance to it (mm), shape (M, 3)."""
    error, cosine = errors_along_ray(data, model, batch)
    used = batch.valid[0].reshape(-1).nonzero()[:, 0]
    used = used[torch.from_numpy(thinned(np.arange(len(used)), _POINTS_SHOWN))]
    distance_mm = (error * cosine)[0].reshape(-1)[used]
    transform = model.hand_eye().detach()
    rays = data.ray_directions().reshape(-1, 3)[used] @ transform[:3, :3].T
    along = batch.radial_distance[0].reshape(-1)[used]
    normal = batch.normal_tool[0]
    points = rays * along[:, None]
    return torch.cat([points @ tangents(normal).T, distance_mm[:, None]], dim=1).numpy()
