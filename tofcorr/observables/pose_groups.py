"""Which frames of a recording were taken without moving."""

import numpy as np

from tofcorr.data.recording import Recording

# Successive frames count as one pose if no entry of pose or plane differs by more than this, metres
# or no unit. Chosen: a robot that stands still reports its joints to about 0.05 mm and 0.05 mrad.
_STANDSTILL = 5e-5


def pose_groups(recording: Recording) -> list[np.ndarray]:
    """Return the numbers of the frames of every pose, poses in the order of their first frame.

    Frames of one `pose_id` and target belong together. Without a `pose_id`, successive frames whose
    recorded pose, plane and target do not change do.

    Args:
        recording: The recording.

    Returns:
        One array of frame numbers a pose; together they hold every frame once.
    """
    table = recording.frames
    named = table.pose_id if table.pose_id is not None else np.full(len(table), "")
    still = _stands_still(recording)
    groups: dict[tuple[str, str], list[int]] = {}
    stretch = 0
    for frame in range(len(table)):
        stretch += not still[frame]
        name = f"pose {named[frame]}" if named[frame] != "" else f"stretch {stretch}"
        groups.setdefault((name, str(table.target[frame])), []).append(frame)
    return [np.array(frames) for frames in groups.values()]


def _stands_still(recording: Recording) -> np.ndarray:
    """Whether each frame has the pose, plane and target of the one before, shape (F,)."""
    table = recording.frames
    place = np.concatenate(
        [
            table.world_from_tool.reshape(len(table), -1),
            table.normal_world,
            table.offset[:, None],
        ],
        axis=1,
    )
    same = np.zeros(len(table), dtype=bool)
    same[1:] = (np.abs(np.diff(place, axis=0)) <= _STANDSTILL).all(1)
    same[1:] &= table.target[1:] == table.target[:-1]
    return same
