"""Chooses a model by how well it predicts what it has not seen."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from tofcorr.comparison.evaluation_options import NamedModel
from tofcorr.comparison.model_fitter import ModelFitter
from tofcorr.comparison.ranking import Ranking, rank
from tofcorr.comparison.selection_options import Grouping, SelectionOptions
from tofcorr.comparison.trials import Trial, measure
from tofcorr.comparison.union import moments_of_models
from tofcorr.error_terms.domain import Domain
from tofcorr.error_terms.model import ErrorModel
from tofcorr.errors import CalibrationDataError
from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.domain import covered_domain
from tofcorr.pixels.metrics import FrameErrors
from tofcorr.pixels.outliers import without_outliers
from tofcorr.pixels.split import folds

# Fewer poses than this are no training set.
_FEWEST_POSES = 3


@dataclass(frozen=True)
class Selection:
    """The choice.

    Attributes:
        rankings: The models compared, by what was held out.
        held_out: The groups held out in turn, by what they are groups of: name and frames.
        skipped: Why a grouping was not possible, by grouping.
        warnings: What a reader must know.
    """

    rankings: dict[Grouping, Ranking]
    held_out: dict[Grouping, dict[str, np.ndarray]]
    skipped: dict[Grouping, str] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)

    @property
    def decisive(self) -> Ranking:
        """The ranking that decides: the first one asked for that was possible."""
        return next(iter(self.rankings.values()))


def select(
    dataset: Dataset,
    options: SelectionOptions,
    progress: Callable[[], object] | None = None,
) -> Selection:
    """Fit every model without each group, and compare the errors on what was held out.

    One pass over the pixels serves all fits; another measures them.

    Args:
        dataset: The recordings.
        options: Models and groupings.
        progress: Called after each fit.

    Raises:
        CalibrationDataError: No grouping is possible, or a model needs what a recording lacks.
    """
    dataset = without_outliers(dataset, options.outlier_window_mm)
    everything = np.arange(dataset.num_frames)
    domain = covered_domain(dataset, everything)
    held_out, skipped = group_frames(dataset, options)
    models = {model.name: model.model for model in options.models}
    moments = moments_of_models(dataset, models, domain, options.device)
    fitter = ModelFitter(dataset, domain, moments, options, progress)
    complexity = {model.name: _complexity(model, domain) for model in options.models}
    trials: list[tuple[Grouping, str, Trial]] = [
        (by, model.name, Trial(fitter.fit(model, np.setdiff1d(everything, frames)).model, frames))
        for by, groups in held_out.items()
        for frames in groups.values()
        for model in options.models
    ]
    measured = measure(dataset, [trial for _, _, trial in trials], options.device)
    errors: dict[Grouping, dict[str, list[FrameErrors]]] = {}
    for (by, name, _), found in zip(trials, measured, strict=True):
        errors.setdefault(by, {}).setdefault(name, []).append(found.to_plane)
    rankings: dict[Grouping, Ranking] = {
        by: rank(
            {name: _by_pose(dataset, parts, options) for name, parts in own.items()},
            complexity,
            len(held_out[by]),
        )
        for by, own in errors.items()
    }
    return Selection(rankings, held_out, skipped, fitter.warnings)


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
        if len(groups) < 2 or min(left) < _FEWEST_POSES:
            skipped[by] = (
                f"{len(groups)} group{'s' * (len(groups) != 1)} by {by}, with {min(left)} poses "
                f"left to train on: 2 groups and {_FEWEST_POSES} poses are needed."
            )
            continue
        held_out[by] = groups
    if not held_out:
        raise CalibrationDataError(
            f"{dataset.first.path}: the models cannot be compared on what they have not seen: "
            + " ".join(skipped.values())
        )
    return held_out, skipped


def _by_image(dataset: Dataset, options: SelectionOptions) -> dict[str, np.ndarray]:
    parts = folds(dataset, options.folds, options.seed)
    return {f"fold {k}": part for k, part in enumerate(parts, start=1)}


def _by_distance(dataset: Dataset, options: SelectionOptions) -> dict[str, np.ndarray]:
    poses = dataset.pose_groups()
    distance = _median_distances(dataset)
    count = int(poses.max()) + 1
    of_pose = np.array([np.median(distance[poses == pose]) for pose in range(count)])
    order = np.argsort(of_pose, kind="stable")
    bands = {}
    for part in np.array_split(order, min(options.distance_bands, count)):
        name = f"{of_pose[part].min():.2f} to {of_pose[part].max():.2f} m"
        bands[name] = np.flatnonzero(np.isin(poses, part))
    return bands


def _by_target(dataset: Dataset, options: SelectionOptions) -> dict[str, np.ndarray]:
    del options
    targets = dataset.targets
    return {str(name): np.flatnonzero(targets == name) for name in np.unique(targets)}


def _median_distances(dataset: Dataset) -> np.ndarray:
    """Return each frame's median measured distance, shape (N,), metres."""
    medians = np.full(dataset.num_frames, np.inf)
    for batch in dataset.batches():
        for k, frame in enumerate(batch.indices.tolist()):
            usable = batch.radial_distance[k][batch.valid[k]]
            if usable.numel():
                medians[frame] = float(usable.median())
    return medians


def _by_pose(dataset: Dataset, parts: list[FrameErrors], options: SelectionOptions) -> np.ndarray:
    """Return a model's held-out error of each pose with a usable pixel, in the poses' order."""
    poses = dataset.pose_groups()
    count = int(poses.max()) + 1
    total, pixels = np.zeros(count), np.zeros(count)
    for part in parts:
        sums = part.absolute if options.metric == "mean_abs" else part.squared
        np.add.at(total, poses[part.frames], sums)
        np.add.at(pixels, poses[part.frames], part.count)
    mean = total[pixels > 0] / pixels[pixels > 0]
    return 1e3 * (mean if options.metric == "mean_abs" else np.sqrt(mean))


def _complexity(model: NamedModel, domain: Domain) -> int:
    """Return how many unknowns a model has."""
    unknowns = ErrorModel(model.model, domain).coefficient_vector().numel()
    if model.model.pixel_map is not None:
        unknowns += domain.height * domain.width
    return unknowns + (model.residual is not None) * _NETWORK_UNKNOWNS


# A residual network counts as more than any curve; how much more decides nothing.
_NETWORK_UNKNOWNS = 1000
