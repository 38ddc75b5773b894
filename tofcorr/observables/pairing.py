"""Which poses two recordings share, and which of their pixels can be compared one by one."""

import numpy as np

from tofcorr.data.recording import Recording
from tofcorr.observables.pixel_table import PixelTable
from tofcorr.observables.pose_groups import pose_groups

# Poses and planes agree if no entry differs by more than this, metres or no unit; so do entries of
# K, pixels. Chosen: 0.1 mm and 0.1 mrad are what files in text keep, and less than robots repeat.
_SAME_POSE = 1e-4
_SAME_K = 1e-3
# Recordings are compared pose by pose if at least this share of the real poses has a partner, and
# pixel by pixel then; otherwise as two samples. Chosen: the rest would be lost.
_LEAST_SHARED = 0.8


def shared_poses(real: Recording, sim: Recording) -> dict[int, int] | None:
    """Return the numbers of the simulated poses that equal real ones, by those of the real.

    Returns:
        None if the cameras differ or fewer than four fifths of the real poses were simulated.
    """
    size = (real.camera.height, real.camera.width) == (sim.camera.height, sim.camera.width)
    matrices = np.abs(np.subtract(real.camera.matrix, sim.camera.matrix))
    if not size or matrices.max() > _SAME_K:
        return None
    places = [_places(recording) for recording in (real, sim)]
    found, free = {}, set(range(len(places[1])))
    for number, place in enumerate(places[0]):
        apart = np.abs(places[1] - place).max(axis=1)
        same = [k for k in np.flatnonzero(apart <= _SAME_POSE).tolist() if k in free]
        if same:
            found[number] = same[0]
            free.discard(same[0])
    return found if len(found) >= _LEAST_SHARED * len(places[0]) else None


def _places(recording: Recording) -> np.ndarray:
    """Return pose and plane of the first frame of each pose, shape (P, 20)."""
    table = recording.frames
    first = np.array([frames[0] for frames in pose_groups(recording)])
    parts = (table.world_from_tool.reshape(len(table), 16), table.normal_world)
    return np.concatenate([*parts, table.offset[:, None]], axis=1)[first]


def shared_pixels(
    real: PixelTable, sim: PixelTable, poses: dict[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the rows of the same pixels of the same poses.

    Args:
        real: Pixels of the recording.
        sim: Pixels of the simulated one.
        poses: As `shared_poses` returns them.

    Returns:
        Row numbers in `real` and in `sim`, in the same order.
    """
    of_sim = {number: pose for pose, number in poses.items()}
    renamed = np.array([of_sim.get(pose, -1) for pose in range(int(sim.pose.max()) + 1)])
    size = max(int(real.pixel.max()), int(sim.pixel.max())) + 1
    keys = (real.pose * size + real.pixel, renamed[sim.pose] * size + sim.pixel)
    _, rows, columns = np.intersect1d(*keys, return_indices=True)
    paired = renamed[sim.pose[columns]] >= 0
    return rows[paired], columns[paired]
