"""Which frames are fitted and which are held out; frames of one pose stay together."""

import numpy as np
from pydantic import Field, NonNegativeInt

from tofcorr.errors import CalibrationDataError
from tofcorr.options import Options
from tofcorr.pixels.dataset import Dataset

# Fewest frames to train on: the covariance leaves out one pose of at least three.
_FEWEST_FRAMES = 3


class SplitOptions(Options):
    """Which frames are held out; frames of one pose always stay together.

    Attributes:
        test_fraction: Share of the poses that is held out; 0 trains on everything.
        seed: Seed of the random choice.
    """

    test_fraction: float = Field(default=0.5, ge=0.0, lt=1.0)
    seed: NonNegativeInt = 0


def split_frames(dataset: Dataset, options: SplitOptions) -> tuple[np.ndarray, np.ndarray]:
    """Return the global numbers of the frames to train on and to test on, both sorted.

    Raises:
        CalibrationDataError: Fewer than three frames would be left to train on.
    """
    group = dataset.pose_groups()
    order = np.random.default_rng(options.seed).permutation(int(group.max()) + 1)
    num_test = round(options.test_fraction * len(order))
    test = np.flatnonzero(np.isin(group, order[:num_test]))
    train = np.flatnonzero(~np.isin(group, order[:num_test]))
    if len(train) < _FEWEST_FRAMES:
        raise CalibrationDataError(
            f"{dataset.first.path}: {len(train)} of {dataset.num_frames} frames are left to train "
            f"on, {_FEWEST_FRAMES} are needed; record more, or set split.test_fraction to 0."
        )
    return train, test


def folds(dataset: Dataset, num_folds: int, seed: int) -> list[np.ndarray]:
    """Return the held-out frames of each fold; poses go to the folds at random, in equal numbers.

    Raises:
        CalibrationDataError: There are fewer poses than folds.
    """
    group = dataset.pose_groups()
    num_poses = int(group.max()) + 1
    if num_poses < num_folds:
        raise CalibrationDataError(
            f"{dataset.first.path}: {num_poses} poses cannot be divided into {num_folds} folds; "
            "record more, or ask for fewer folds."
        )
    order = np.random.default_rng(seed).permutation(num_poses)
    return [np.flatnonzero(np.isin(group, part)) for part in np.array_split(order, num_folds)]
