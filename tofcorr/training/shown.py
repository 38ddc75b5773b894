"""Which frames and points the figures of a training show, and their values."""

from collections.abc import Iterator

import numpy as np
import torch

from tofcorr.correction.model import CalibrationModel
from tofcorr.data.frames import FrameBatch
from tofcorr.geometry.planes import tangents
from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.metrics import frame_errors
from tofcorr.pixels.pixel_sample import errors_along_ray, thinned
from tofcorr.training.calibration import Calibration

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
