"""Which frames are fitted and which are held out: the protocols of an evaluation.

A random half split (Table 1 of Abdo and Borgeat 2010), k-fold cross-validation by image (their
Table 2) and repeated random splits. Images of one pose stay together.

Frames that disagree with all others are taken out of the splits that were drawn. A training does
the same, so the half split is that of a training.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from tofcorr.comparison.evaluation_options import EvaluationOptions
from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.split import SplitOptions, folds, split_frames

Protocol = Literal["half", "folds", "repeats"]


@dataclass(frozen=True)
class Split:
    """Frames to fit, and frames to measure on (global numbers)."""

    train: np.ndarray
    test: np.ndarray


def splits_without(splits: Sequence[Split], frames: Sequence[int]) -> list[Split]:
    """Return the splits without some frames, and without those that then hold nothing out."""
    kept = [
        Split(np.setdiff1d(split.train, frames), np.setdiff1d(split.test, frames))
        for split in splits
    ]
    return [
        after
        for before, after in zip(splits, kept, strict=True)
        if len(after.test) or not len(before.test)
    ]


def splits_of(dataset: Dataset, options: EvaluationOptions) -> dict[Protocol, list[Split]]:
    """Return the splits of each protocol that was asked for; the half split always.

    Raises:
        CalibrationDataError: There are too few poses.
    """
    everything = np.arange(dataset.num_frames)
    half = SplitOptions(test_fraction=options.test_fraction, seed=options.seed)
    protocols: dict[Protocol, list[Split]] = {"half": [Split(*split_frames(dataset, half))]}
    if options.folds:
        tests = folds(dataset, options.folds, options.seed)
        protocols["folds"] = [Split(np.setdiff1d(everything, test), test) for test in tests]
    repeats = options.repeats
    if repeats.number:
        seeds = np.random.SeedSequence(options.seed).generate_state(repeats.number)
        drawn = [
            SplitOptions(test_fraction=repeats.test_fraction, seed=int(seed)) for seed in seeds
        ]
        protocols["repeats"] = [Split(*split_frames(dataset, split)) for split in drawn]
    return protocols
