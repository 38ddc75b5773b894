"""Frames that differ by noise alone: one pose, one target, one integration time."""

import numpy as np

from tofcorr.diagnosis.sums.observations import Observations


def same_exposure(observations: Observations) -> list[np.ndarray]:
    """Return the frames of each pose, target and integration time, in the order of the recording.

    Errors change with the integration time, pixel by pixel, and would count as noise.
    """
    time = observations.facts.integration_time
    exposure = np.zeros(observations.num_frames) if time is None else time.numpy()
    target = observations.recording.frames.target
    groups: dict[tuple[int, str, float], list[int]] = {}
    for frame, unit in enumerate(observations.unit.tolist()):
        key = (unit, str(target[frame]), float(np.nan_to_num(exposure[frame])))
        groups.setdefault(key, []).append(frame)
    return [np.array(group) for group in groups.values()]
