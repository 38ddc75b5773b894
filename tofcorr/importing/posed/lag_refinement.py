r"""The lag between images and poses, once the walls are known.

Of an image taken while the tool moved, the planes lie on their walls if its pose is taken at the
right time. With hand-eye and walls from the stops, where the lag does not matter,

.. math:: \hat L = \arg\min_L \sum_k \rho\left(r_k(t_k - L)\right)

with :math:`r_k` the distances of a plane's points to its wall and :math:`\rho` Cauchy's loss.
"""

from typing import Any

import numpy as np
import torch
from scipy.optimize import minimize_scalar
from torch import Tensor

from tofcorr.importing.poses.track import PoseTrack
from tofcorr.importing.timing.lag import Lag

_WINDOW = 0.15
"""Seconds around the first estimate that are searched: its error, seen in simulated stop-and-go
motion at 5 to 30 images a second, is below 0.03 s."""

_FEWEST = 10
"""Fewer planes of moving images do not improve the first estimate. One for each part that is left
out in turn."""

_SCALE = 0.01
"""Scale of Cauchy's loss, metres: the error of a camera that is not calibrated yet."""

_GROUPS = 10
"""Parts of the recording that are left out in turn for the standard error. Set by hand: ten tell it
to a quarter."""


def refine_lag(
    track: PoseTrack,
    times: np.ndarray,
    points: Tensor,
    normal: Tensor,
    offset: Tensor,
    tool_from_camera: np.ndarray,
    first: Lag,
) -> Lag:
    """Refine a lag on planes seen while the tool moved.

    Args:
        track: The poses, with time stamps.
        times: Time stamp of each plane's image, shape (M,), seconds.
        points: Points of each plane in the camera frame, shape (M, P, 3), metres.
        normal: Unit normal of each plane's wall in the world, shape (M, 3).
        offset: d of each plane's wall, shape (M,), metres.
        tool_from_camera: Shape (4, 4), metres.
        first: The first estimate.

    Returns:
        The refined lag; `first` where too few planes were seen in motion.
    """
    if len(times) < _FEWEST:
        return first
    in_tool = points @ torch.from_numpy(tool_from_camera[:3, :3]).T
    in_tool = (in_tool + torch.from_numpy(tool_from_camera[:3, 3])).numpy()
    wall, d = normal.numpy(), offset.numpy()
    group = np.arange(len(times)) * _GROUPS // len(times)

    def losses(lag: float) -> np.ndarray:
        pose = track.at(times - lag)
        turned = np.einsum("nab,npb->npa", pose[:, :3, :3], in_tool) + pose[:, None, :3, 3]
        off = np.einsum("npa,na->np", turned, wall) + d[:, None]
        return np.log1p((off / _SCALE) ** 2).mean(axis=1)

    def best(used: np.ndarray) -> float:
        bounds = (first.seconds - _WINDOW, first.seconds + _WINDOW)
        found: Any = minimize_scalar(
            lambda lag: float(np.nanmean(losses(lag)[used])), bounds=bounds, method="bounded",
            options={"xatol": 1e-4},
        )  # fmt: skip
        return float(found.x)

    everything = np.ones(len(times), dtype=bool)
    seconds = best(everything)
    left_out = np.array([best(group != k) for k in range(_GROUPS)])
    spread = (_GROUPS - 1) / _GROUPS * np.sum((left_out - left_out.mean()) ** 2)
    return Lag(
        seconds=seconds, standard_error=float(np.sqrt(spread)), correlation=first.correlation
    )
