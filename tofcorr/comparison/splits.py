"""Which frames are fitted and which are held out, as `evaluate` and as `select` ask.

`evaluate`: a random half split (Table 1 of Abdo and Borgeat 2010), k-fold cross-validation by image
(their Table 2) and repeated random splits. `select`: images, bands of distance and targets, held
out group by group. Images of one pose stay together.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from tofcorr.comparison.options import EvaluationOptions, SelectionOptions
from tofcorr.errors import CalibrationDataError
from tofcorr.pixels.dataset import Dataset, SplitOptions, folds, split_frames

# Fewest poses to train on. Three tilted views are the least that determine a hand-eye transform
# from planes; the fit itself refuses what more unknowns need.
_FEWEST_POSES = 3


class Split(NamedTuple):
    """Frames to fit, and frames to measure on (global numbers)."""

    train: np.ndarray
    test: np.ndarray


Splits = dict[str, dict[str, Split]]
"""Splits by protocol or by what their groups are groups of, then by name."""


def without_frames(splits: Mapping[str, Split], frames: Sequence[int]) -> dict[str, Split]:
    """Return the splits without some frames, and without those that then hold nothing out.

    Frames that disagree with all others are taken out of splits that were drawn with them, as a
    training does: so the half split is that of a training.
    """
    kept = {
        name: Split(np.setdiff1d(split.train, frames), np.setdiff1d(split.test, frames))
        for name, split in splits.items()
    }
    return {
        name: split for name, split in kept.items() if len(split.test) or not len(splits[name].test)
    }


def protocols(dataset: Dataset, options: EvaluationOptions) -> Splits:
    """Return the splits of each protocol that was asked for; the half split always.

    Raises:
        CalibrationDataError: There are too few poses.
    """

    def drawn(fraction: float, seed: int) -> Split:
        return Split(*split_frames(dataset, SplitOptions(test_fraction=fraction, seed=seed)))

    found: Splits = {"half": {"half": drawn(options.test_fraction, options.seed)}}
    if options.folds:
        found["folds"] = _held_out(dataset, _by_image(dataset, options))
    repeats = options.repeats
    if repeats.number:
        seeds = np.random.SeedSequence(options.seed).generate_state(repeats.number)
        found["repeats"] = {
            f"repeat {k}": drawn(repeats.test_fraction, int(seed))
            for k, seed in enumerate(seeds, start=1)
        }
    return found


def groupings(dataset: Dataset, options: SelectionOptions) -> tuple[Splits, dict[str, str]]:
    """Return the groups of frames to hold out in turn, and why a grouping is not possible.

    Raises:
        CalibrationDataError: None of them is possible.
    """
    makers = {"image": _by_image, "distance": _by_distance, "target": _by_target}
    found: Splits = {}
    skipped: dict[str, str] = {}
    poses = dataset.pose_groups()
    for by in options.by:
        try:
            splits = _held_out(dataset, makers[by](dataset, options))
        except CalibrationDataError as error:
            skipped[by] = str(error)
            continue
        left = {name: len(np.unique(poses[split.train])) for name, split in splits.items()}
        scarce = min(left, key=left.__getitem__)
        if len(splits) < 2:
            skipped[by] = f"the recording has one {by} only."
        elif left[scarce] < _FEWEST_POSES:
            skipped[by] = (
                f"without {scarce} {left[scarce]} poses are left to fit, and {_FEWEST_POSES} are "
                "needed."
            )
        else:
            found[by] = splits
    if not found:
        raise CalibrationDataError(
            f"{dataset.first.path}: no images can be held out to compare the models: "
            + " ".join(skipped.values())
        )
    return found, skipped


def _held_out(dataset: Dataset, groups: Mapping[str, np.ndarray]) -> dict[str, Split]:
    everything = np.arange(dataset.num_frames)
    return {name: Split(np.setdiff1d(everything, test), test) for name, test in groups.items()}


def _by_image(
    dataset: Dataset, options: EvaluationOptions | SelectionOptions
) -> dict[str, np.ndarray]:
    tests = folds(dataset, options.folds, options.seed)
    return {f"fold {k}": frames for k, frames in enumerate(tests, start=1)}


def _by_distance(dataset: Dataset, options: SelectionOptions) -> dict[str, np.ndarray]:
    poses = dataset.pose_groups()
    distance = _median_distances(dataset)
    of_pose = np.array([np.median(distance[poses == pose]) for pose in range(poses.max() + 1)])
    order = np.argsort(of_pose, kind="stable")
    return {
        f"{of_pose[band].min():.2f} to {of_pose[band].max():.2f} m": np.flatnonzero(
            np.isin(poses, band)
        )
        for band in np.array_split(order, min(options.distance_bands, len(order)))
    }


def _by_target(dataset: Dataset, options: SelectionOptions) -> dict[str, np.ndarray]:
    del options
    targets = dataset.targets
    return {str(name): np.flatnonzero(targets == name) for name in np.unique(targets)}


def _median_distances(dataset: Dataset) -> np.ndarray:
    """Return each frame's median measured distance, shape (N,), metres; no usable pixel: inf."""
    medians = np.full(dataset.num_frames, np.inf)
    for batch in dataset.batches():
        for k, frame in enumerate(batch.indices.tolist()):
            usable = batch.radial_distance[k][batch.valid[k]]
            if usable.numel():
                medians[frame] = float(usable.median())
    return medians
