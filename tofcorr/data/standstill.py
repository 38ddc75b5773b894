"""Which frames of a recording were taken without moving."""

import numpy as np

from tofcorr.data.recording import Recording

# Successive frames count as one pose if no entry of pose or plane differs from the first of them by
# more than this, metres or no unit. Chosen: a robot that stands still reports its joints to about
# 0.05 mm and 0.05 mrad.
_STANDSTILL = 5e-5


def pose_numbers(recording: Recording) -> np.ndarray:
    """Return a number for each frame, shape (N,), int; frames taken without moving share it.

    Frames of one `pose_id` do. Frames without one do if they follow each other, a robot moves the
    camera, and the recorded pose, plane and target do not change.

    Args:
        recording: The recording.

    Returns:
        Numbers from 0 on, in the order of the first frame of each pose.
    """
    table = recording.frames
    named = table.pose_id if table.pose_id is not None else np.full(len(table), "")
    stretch = _stretches(recording)
    names = [
        f"pose {p}" if p != "" else f"stretch {k}" for p, k in zip(named, stretch, strict=True)
    ]
    first_seen: dict[str, int] = {}
    return np.array([first_seen.setdefault(name, len(first_seen)) for name in names])


def _stretches(recording: Recording) -> np.ndarray:
    """Return a number for each frame, shape (N,); frames in a row that stand still share it."""
    table = recording.frames
    if not recording.moves:  # Nothing says that the target stood still where no pose is recorded.
        return np.arange(len(table))
    place = np.concatenate(
        [
            table.world_from_tool.reshape(len(table), -1),
            table.normal_world,
            table.offset[:, None],
        ],
        axis=1,
    )
    number = np.zeros(len(table), dtype=int)
    first = 0
    for frame in range(1, len(table)):
        # Compared with the first of the stretch: a slow robot moves less from frame to frame.
        same = np.abs(place[frame] - place[first]).max() <= _STANDSTILL
        if not (same and table.target[frame] == table.target[first]):
            first = frame
        number[frame] = number[frame - 1] + (first == frame)
    return number
