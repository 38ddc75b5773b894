"""What figures of a calibration show: profiles of errors, and frames, as numbers and colours."""

from collections.abc import Mapping, Sequence

import numpy as np
import torch

from tofcorr.geometry.rays import tangents
from tofcorr.pixels.metrics import frame_errors
from tofcorr.pixels.sample import errors_along_ray, thinned
from tofcorr.training.calibration import Calibration


def profile(
    x: np.ndarray,
    error: np.ndarray,
    ends: tuple[float, float] | None = None,
    bins: int = 30,
    fewest: int = 30,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return middles of bins of a covariate, and mean and standard deviation of the error in them.

    Args:
        x: The covariate, shape (M,).
        error: The error of each pixel, shape (M,); NaN is left out.
        ends: Range of the covariate; its central 99.8 % if None.
        bins: How many.
        fewest: Bins of fewer pixels are left out: their mean is mostly noise.
    """
    edges = np.linspace(*(ends or ends_of(x)), bins + 1)
    number = np.digitize(x, edges) - 1
    inside = (number >= 0) & (number < bins) & np.isfinite(error)
    count, total, square = (
        np.bincount(number[inside], weights, bins)
        for weights in (None, error[inside], error[inside] ** 2)
    )
    enough = count >= fewest
    mean = total[enough] / count[enough]
    spread = np.sqrt(np.maximum(square[enough] / count[enough] - mean**2, 0))
    return ((edges[1:] + edges[:-1]) / 2)[enough], mean, spread


def ends_of(x: np.ndarray) -> tuple[float, float]:
    """Return the range of the central 99.8 % of a covariate."""
    low, high = np.quantile(x, (0.001, 0.999))
    return float(low), float(high)


# Colours from too near to too far, of 255, in equal steps: the diverging scale of ColorBrewer
# (RdBu). Pixels that are not used are grey, which is no colour of it.
_SCALE = np.array(
    [(33, 102, 172), (146, 197, 222), (247, 247, 247), (244, 165, 130), (178, 24, 43)]
)
_NOT_USED = 190


def columns_of_errors(
    images: Sequence[Mapping[str, np.ndarray]], within: float = 0.98
) -> list[tuple[np.ndarray, float]]:
    """Return errors before, after, and after on a finer scale: frames below one another, and limit.

    Args:
        images: For each frame `before` and `after`, shape (H, W), mm; NaN where not used.
        within: Share of the pixels within a scale.

    Returns:
        Three images with a gap of NaN between frames, and the limits of their colours, mm.
    """

    def stacked(stage: str) -> np.ndarray:
        gap = np.full((gap_rows(len(images[0][stage])), images[0][stage].shape[1]), np.nan)
        return np.concatenate([part for one in images for part in (one[stage], gap)][:-1])

    before, after = stacked("before"), stacked("after")
    known = [np.abs(column[np.isfinite(column)]) for column in (before, after)]
    common, own = (float(np.quantile(one, within)) or 1.0 if one.size else 1.0 for one in known)
    return [(before, common), (after, common), (after, own)]


def gap_rows(height: int) -> int:
    """Return the rows left free between two frames, pixels."""
    return max(height // 25, 1)


def coloured(image: np.ndarray, limit: float) -> np.ndarray:
    """Return an image of errors (H, W) in colours, shape (H, W, 3), uint8; NaN is grey."""
    place = (np.clip(image / limit, -1, 1) + 1) / 2 * (len(_SCALE) - 1)
    known, steps = np.isfinite(image), np.arange(len(_SCALE))
    channels = [np.interp(np.where(known, place, 0.0), steps, one) for one in _SCALE.T]
    shown = np.where(known[..., None], np.stack(channels, axis=-1), _NOT_USED)
    return shown.round().astype(np.uint8)


def error_picture(
    images: Sequence[Mapping[str, np.ndarray]], titles: Sequence[str], least_width: int = 600
) -> tuple[np.ndarray, str]:
    """Return errors before, after, and after once more on a finer scale, and what it shows.

    Args:
        images: For each frame `before` and `after`, shape (H, W), mm; NaN where not used.
        titles: One a frame.
        least_width: Smaller pictures are enlarged by a whole factor, pixels.

    Returns:
        One row a frame, (H, W, 3), uint8; and the words, in Markdown.
    """
    columns = columns_of_errors(images)
    first, second, third = (coloured(column, limit) for column, limit in columns)
    (_, common), (_, own) = columns[1:]
    free = np.full((len(first), gap_rows(first.shape[1]), 3), 255, dtype=np.uint8)
    picture = np.concatenate([first, free, second, free, third], axis=1)
    factor = -(-least_width // picture.shape[1])
    rows = "\n".join(f"{n}. {title.replace(chr(10), ', ')}" for n, title in enumerate(titles, 1))
    words = (
        f"Errors along the ray: blue too near, red too far, grey not used. Left: before, up to "
        f"{common:.1f} mm. Middle: after, the same scale. Right: after, up to {own:.2f} mm. "
        f"From top to bottom:\n\n{rows}"
    )
    return picture.repeat(factor, axis=0).repeat(factor, axis=1), words


def frames_to_show(calibration: Calibration, shown: int = 5, pixels: int = 3_000_000) -> np.ndarray:
    """Return global numbers of frames from the best corrected to the worst, at regular ranks.

    Args:
        calibration: The fitted model.
        shown: How many: as many as fit on a page.
        pixels: About how many are measured to choose them; bounds the time on long recordings.
    """
    data = calibration.data
    most = max(pixels // (data.first.camera.height * data.first.camera.width), shown)
    ranked = thinned(np.sort(np.concatenate([calibration.train, calibration.test])), most)
    errors = frame_errors(data, {"after": calibration.stages["after"]}, ranked)["after"]
    used = errors.count > 0
    order = np.argsort(errors.squared[used] / errors.count[used])
    return thinned(errors.frames[used][order], shown)


def error_images(
    calibration: Calibration, frames: np.ndarray
) -> tuple[list[dict[str, np.ndarray]], list[str]]:
    """Return each frame's errors `before` and `after` along the ray, (H, W), mm, and its title.

    Args:
        calibration: The fitted model.
        frames: Global numbers, in any order.
    """
    data, stages, images, titles = calibration.data, calibration.stages, [], []
    for frame in frames:
        (batch,) = data.batches(np.array([frame]))
        errors = {s: errors_along_ray(data, stages[s], batch)[0] for s in ("before", "after")}
        images.append({stage: error[0].numpy() for stage, error in errors.items()})
        half = "held out" if frame in calibration.test else "fitted"
        titles.append(f"frame {frame}, {data.targets[frame]}\n{half}")
    return images, titles


def points_on_plane(
    calibration: Calibration, frame: int, points: int = 4000
) -> tuple[dict[str, np.ndarray], str]:
    """Return one frame's points on its plane at each stage, and a title.

    Args:
        calibration: The fitted model.
        frame: Global number of the frame.
        points: About how many of its points.

    Returns:
        For each stage, shape (M, 3): two coordinates within the plane, metres, and the distance
        to the plane, millimetres.
    """
    data, clouds = calibration.data, {}
    (batch,) = data.batches(np.array([frame]))
    used = torch.from_numpy(thinned(batch.valid[0].flatten().nonzero()[:, 0].numpy(), points))
    rays, along = data.ray_directions().flatten(0, 1)[used], batch.radial_distance.flatten()[used]
    for name, model in calibration.stages.items():
        error, cosine = errors_along_ray(data, model, batch)
        seen = (rays @ model.hand_eye().detach()[:3, :3].T) * along[:, None]
        within = seen @ tangents(batch.normal_tool[0]).T
        clouds[name] = torch.cat([within, (error * cosine).flatten()[used, None]], dim=1).numpy()
    return clouds, f"Frame {frame}, {data.targets[frame]}: points and plane, height stretched"
