"""Every model without each group of frames, ranked by the errors on what was held out."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from tofcorr.comparison.held_out_errors import FittedModel, held_out_errors
from tofcorr.comparison.held_out_groups import group_frames
from tofcorr.comparison.model_fitter import ModelFitter
from tofcorr.comparison.ranking import Ranking, rank
from tofcorr.comparison.selection_options import Grouping, SelectionOptions
from tofcorr.error_terms.domain import Domain
from tofcorr.error_terms.model import ErrorModel
from tofcorr.fit.unknown_walls import name_walls
from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.masks import usable_pixels
from tofcorr.pixels.metrics import FrameErrors
from tofcorr.plausibility.inspection import Inspection
from tofcorr.training.left_out import frames_left_out, left_out_mapping, left_out_words
from tofcorr.training.options import TrainingOptions

# Unknowns that a residual network counts for: more than any curve has, so that it is chosen only
# where no curve comes within one standard error of it. Its true number would do the same.
_NETWORK_UNKNOWNS = 1000


@dataclass(frozen=True)
class HeldOutRankings:
    """The models ranked by what was held out.

    Attributes:
        rankings: The models ranked, by what was held out.
        held_out: The groups held out in turn, by what they are groups of: name and frames.
        skipped: Why a grouping was not possible, by grouping.
        left_out: Frames that are neither fitted nor measured, and how far off they are, as in the
            report of a training.
        warnings: What limits the choice, one sentence each.
    """

    rankings: dict[Grouping, Ranking]
    held_out: dict[Grouping, dict[str, np.ndarray]]
    skipped: dict[Grouping, str] = field(default_factory=dict)
    left_out: list[dict[str, Any]] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)

    @property
    def decisive(self) -> Ranking:
        """The ranking that decides: the first one asked for that was possible."""
        return next(iter(self.rankings.values()))


def rank_models(
    dataset: Dataset,
    options: SelectionOptions,
    progress: Callable[[], object] | None = None,
    inspection: Inspection | None = None,
) -> HeldOutRankings:
    """Fit every model without each group of frames, and rank by the errors on the group.

    Every model is measured on the same pixels: those of the recordings' masks that the options'
    own masks leave.

    Args:
        dataset: The recordings.
        options: Models and groupings.
        progress: Called after each fit.
        inspection: What was odd about the recordings. Frames that disagree with all others are
            left out, as a training leaves them out, and garbage is met as there; None: neither.

    Raises:
        CalibrationDataError: No grouping is possible, or a model needs what a recording lacks.
    """
    options = options.for_recordings(dataset.recordings).against_garbage(inspection)
    everything = np.arange(dataset.num_frames)
    # The masks alone say which pixels the groups look at.
    held_out, skipped = group_frames(usable_pixels(dataset, options, robust=False), options)
    left_out: tuple[int, ...] = ()
    if inspection is not None:
        groups = [frames for own in held_out.values() for frames in own.values()]
        left_out = frames_left_out(inspection, [np.delete(everything, own) for own in groups])
        for by, own in held_out.items():
            kept = {name: np.setdiff1d(frames, left_out) for name, frames in own.items()}
            held_out[by] = {name: frames for name, frames in kept.items() if len(frames)}
    everything = np.setdiff1d(everything, left_out)
    fitter = ModelFitter(dataset, options, progress, left_out)
    complexity = {
        model.name: _complexity(options.training(model), fitter.domain, dataset)
        for model in options.models
    }
    fitted: list[tuple[Grouping, str, FittedModel]] = [
        (by, model.name, fitter.fit(model, np.setdiff1d(everything, frames), frames))
        for by, groups in held_out.items()
        for frames in groups.values()
        for model in options.models
    ]
    measured = held_out_errors(fitter.measured, [one for _, _, one in fitted], options.device)
    errors: dict[Grouping, dict[str, list[FrameErrors]]] = {}
    for (by, name, _), found in zip(fitted, measured, strict=True):
        errors.setdefault(by, {}).setdefault(name, []).append(found.to_plane)
    rankings: dict[Grouping, Ranking] = {
        by: rank(
            {name: _by_pose(dataset, groups, options) for name, groups in own.items()},
            complexity,
            len(held_out[by]),
        )
        for by, own in errors.items()
    }
    return HeldOutRankings(
        rankings=rankings,
        held_out=held_out,
        skipped=skipped,
        left_out=[] if inspection is None else left_out_mapping(left_out, inspection),
        warnings=[*left_out_words(left_out), *fitter.warnings],
    )


def _by_pose(dataset: Dataset, groups: list[FrameErrors], options: SelectionOptions) -> np.ndarray:
    """Return a model's held-out error of each pose with a usable pixel, in the poses' order, mm."""
    poses = dataset.pose_groups()
    count = int(poses.max()) + 1
    total, pixels = np.zeros(count), np.zeros(count)
    for group in groups:
        sums = group.absolute if options.metric == "mean_abs" else group.squared
        np.add.at(total, poses[group.frames], sums)
        np.add.at(pixels, poses[group.frames], group.count)
    mean = total[pixels > 0] / pixels[pixels > 0]
    return 1e3 * (mean if options.metric == "mean_abs" else np.sqrt(mean))


def _complexity(training: TrainingOptions, domain: Domain, dataset: Dataset) -> int:
    """Return how many unknowns a model has beside the hand-eye transform."""
    unknowns = ErrorModel(training.model, domain).coefficient_vector().numel()
    if training.model.pixel_map is not None:
        unknowns += domain.height * domain.width
    if training.planes == "unknown":
        unknowns += 3 * len(name_walls(dataset).names)
    return unknowns + (training.residual is not None) * _NETWORK_UNKNOWNS
