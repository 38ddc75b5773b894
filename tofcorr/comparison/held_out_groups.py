"""Groups of frames that `select` holds out in turn: images, bands of distance, targets."""

from collections.abc import Callable

import numpy as np

from tofcorr.comparison.selection_options import Grouping, SelectionOptions
from tofcorr.errors import CalibrationDataError
from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.split import folds

# Fewest poses to train on. Three tilted views are the least that determine a hand-eye transform
# from planes; the fit itself refuses what more unknowns need.
_FEWEST_POSES = 3


def group_frames(
    dataset: Dataset, options: SelectionOptions
) -> tuple[dict[Grouping, dict[str, np.ndarray]], dict[Grouping, str]]:
    """Return the groups of frames to hold out in turn, and why a grouping is not possible.

    Raises:
        CalibrationDataError: None of them is possible.
    """
    makers: dict[Grouping, Callable[[Dataset, SelectionOptions], dict[str, np.ndarray]]] = {
        "image": _by_image,
        "distance": _by_distance,
        "target": _by_target,
    }
    held_out: dict[Grouping, dict[str, np.ndarray]] = {}
    skipped: dict[Grouping, str] = {}
    poses = dataset.pose_groups()
    for by in options.by:
        try:
            groups = makers[by](dataset, options)
        except CalibrationDataError as error:
            skipped[by] = str(error)
            continue
        left = [len(np.unique(np.delete(poses, frames))) for frames in groups.values()]
        if len(groups) < 2:
            skipped[by] = f"the recording has one {by} only."
            continue
        if min(left) < _FEWEST_POSES:
            scarce = list(groups)[int(np.argmin(left))]
            skipped[by] = (
                f"without {scarce} {min(left)} poses are left to fit, and {_FEWEST_POSES} are "
                "needed."
            )
            continue
        held_out[by] = groups
    if not held_out:
        raise CalibrationDataError(
            f"{dataset.first.path}: no images can be held out to compare the models: "
            + " ".join(skipped.values())
        )
    return held_out, skipped


def _by_image(dataset: Dataset, options: SelectionOptions) -> dict[str, np.ndarray]:
    tests = folds(dataset, options.folds, options.seed)
    return {f"fold {k}": frames for k, frames in enumerate(tests, start=1)}


def _by_distance(dataset: Dataset, options: SelectionOptions) -> dict[str, np.ndarray]:
    poses = dataset.pose_groups()
    distance = _median_distances(dataset)
    count = int(poses.max()) + 1
    of_pose = np.array([np.median(distance[poses == pose]) for pose in range(count)])
    order = np.argsort(of_pose, kind="stable")
    bands = {}
    for band in np.array_split(order, min(options.distance_bands, count)):
        name = f"{of_pose[band].min():.2f} to {of_pose[band].max():.2f} m"
        bands[name] = np.flatnonzero(np.isin(poses, band))
    return bands


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
