"""One fitting problem: which frames of which data set, which model, and where to start."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from tofcorr.error_terms.domain import Domain
from tofcorr.estimation.solution import Watcher
from tofcorr.fit.options import FitOptions
from tofcorr.fit.start import Start
from tofcorr.fit.unknown_walls import FoundWalls
from tofcorr.pixels.dataset import Dataset


@dataclass(frozen=True)
class Problem:
    """Everything that the steps of a fit look at, apart from the moments.

    Attributes:
        dataset: The recordings, with the walls found once they are found.
        frames: Global numbers of the frames to fit, shape (N,).
        options: Model, hand-eye, solver and device.
        domain: The ranges that scale the model's variables.
        start: Where the solver starts.
        watcher: Called after each iteration of the solver.
        walls: The estimated walls; None as long as the recorded ones are used.
    """

    dataset: Dataset
    frames: np.ndarray
    options: FitOptions
    domain: Domain
    start: Start
    watcher: Watcher | None = None
    walls: FoundWalls | None = None

    def conditions(self) -> Tensor:
        """Return the frames' conditions, shape (N, C) in the order of `CONDITIONS`."""
        return self.dataset.conditions(self.frames)

    def poses(self) -> np.ndarray:
        """Return the pose of each frame, shape (N,): integers, the same for frames of one pose."""
        return self.dataset.pose_groups()[self.frames]

    def numbered_poses(self) -> Tensor:
        """Return the pose of each frame, shape (N,), numbered from zero without gaps."""
        return torch.from_numpy(np.unique(self.poses(), return_inverse=True)[1])

    def with_walls(self, walls: FoundWalls, start: Start) -> "Problem":
        """Return the problem on the walls found, started where the recorded walls led."""
        return replace(self, dataset=walls.put_into(self.dataset), start=start, walls=walls)
