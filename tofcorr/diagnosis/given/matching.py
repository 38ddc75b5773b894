"""Which rendered frames show what a frame of the recording shows."""

from dataclasses import dataclass

import numpy as np

from tofcorr.conditions import CONDITIONS
from tofcorr.data.frames import planes_in_tool
from tofcorr.data.recording import Recording

# A frame was rendered at the pose of a recorded one if tool and target differ by no more than this:
# metres for the position of the tool and the distance of the target's plane, radians for the turn
# of either. Chosen: geometry is corrected for the difference, and errors of a camera hardly change.
_TOLERANCE = 1e-3
# Frames within this share of the tolerance of the nearest one are renders of one pose. Chosen: what
# the rounding of a text file leaves.
_SAME_POSE = 0.01
# Relative difference of two equal values of a condition. Chosen: the rounding of a text file.
_SAME_CONDITION = 1e-5
# Poses are matched if this share of the recorded frames has a render; otherwise the simulator is
# taken to have seen other poses. Chosen: with fewer, a render of other poses says more.
_LEAST_MATCHED = 0.5


@dataclass(frozen=True, kw_only=True)
class Matches:
    """The rendered frames of every recorded frame.

    Attributes:
        renders: For each frame of the recording the numbers of its renders, in order; may be empty.
    """

    renders: tuple[np.ndarray, ...]

    @property
    def missing(self) -> int:
        """Number of recorded frames without a render."""
        return sum(len(found) == 0 for found in self.renders)

    @property
    def enough(self) -> bool:
        """Whether the renders are of the recording's own poses."""
        return 1 - self.missing / len(self.renders) >= _LEAST_MATCHED


def match_frames(real: Recording, simulated: Recording) -> Matches:
    """Find the renders of each recorded frame: the nearest pose, the same target and conditions.

    Several renders of one pose all count. A target, a time or another condition chooses among them
    where some of them agree with the recorded frame.

    Args:
        real: The recording.
        simulated: The rendered frames, in any order.
    """
    here, there = _places(real), _places(simulated)
    renders = []
    for frame, place in enumerate(here):
        away = _difference(place, there)
        near = np.flatnonzero(away <= min(away.min() + _SAME_POSE, 1.0))
        renders.append(_alike(real, simulated, frame, near))
    return Matches(renders=tuple(renders))


def _places(recording: Recording) -> np.ndarray:
    """Return position and rotation of the tool, normal and distance of the plane there, (F, 16)."""
    pose = recording.frames.world_from_tool
    normal, offset = (values.numpy() for values in planes_in_tool(recording))
    return np.concatenate(
        [pose[:, :3, 3], offset[:, None], pose[:, :3, :3].reshape(-1, 9), normal], axis=1
    )


def _difference(place: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return the largest difference in units of the tolerance, shape (S,)."""
    apart = others - place
    # A turn by a small angle changes a rotation matrix by sqrt(2) times the angle.
    sizes = [
        np.linalg.norm(apart[:, :3], axis=1),
        np.abs(apart[:, 3]),
        np.linalg.norm(apart[:, 4:13], axis=1) / np.sqrt(2),
        np.linalg.norm(apart[:, 13:], axis=1),
    ]
    return np.max(sizes, axis=0) / _TOLERANCE


def _alike(real: Recording, simulated: Recording, frame: int, near: np.ndarray) -> np.ndarray:
    """Keep the renders whose target, and then each condition, agree; all where none agrees."""
    tables = real.frames, simulated.frames
    agree = [tables[1].target[near] == tables[0].target[frame]]
    for name in CONDITIONS:
        own, others = (getattr(table, name) for table in tables)
        if own is not None and others is not None:
            apart = np.abs(others[near] - own[frame])
            agree.append(apart <= _SAME_CONDITION * max(abs(float(own[frame])), 1e-9))
    kept = np.ones(len(near), dtype=bool)
    for same in agree:
        if (kept & same).any():
            kept &= same
    return near[kept]


def repeats_of(recording: Recording) -> np.ndarray:
    """Return a number for each frame without a pose_id; renders of one pose share it, (F,)."""
    table = recording.frames
    _, target = np.unique(table.target, return_inverse=True)
    rows = [np.round(_places(recording) / (_SAME_POSE * _TOLERANCE)), target[:, None]]
    if table.integration_time is not None:
        rows.append(np.round(np.log(table.integration_time) / _SAME_CONDITION)[:, None])
    keys = np.nan_to_num(np.concatenate(rows, axis=1), nan=-1.0)
    return np.unique(keys, axis=0, return_inverse=True)[1].reshape(-1)
