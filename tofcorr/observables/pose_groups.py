"""Which frames of a recording show one target from one pose."""

import numpy as np

from tofcorr.data.recording import Recording, pose_numbers


def pose_groups(recording: Recording) -> list[np.ndarray]:
    """Return the numbers of the frames of every pose and target, in the order of the first frame.

    Args:
        recording: The recording.

    Returns:
        One array of frame numbers a group; together they hold every frame once.
    """
    groups: dict[tuple[int, str], list[int]] = {}
    pairs = zip(pose_numbers(recording), recording.frames.target, strict=True)
    for frame, (pose, target) in enumerate(pairs):
        groups.setdefault((int(pose), str(target)), []).append(frame)
    return [np.array(frames) for frames in groups.values()]
