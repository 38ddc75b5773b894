"""All models on one set of images: the errors on frames that they were not fitted to."""

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import combinations
from typing import Any, Literal

import numpy as np
from torch import Tensor

from tofcorr.comparison.evaluation_options import BEFORE, HAND_EYE_ONLY, EvaluationOptions
from tofcorr.comparison.held_out_errors import FittedModel, HeldOutErrors, held_out_errors
from tofcorr.comparison.model_fitter import ModelFitter
from tofcorr.comparison.split_statistics import Estimate, over_folds, over_repeats
from tofcorr.comparison.splits import Protocol, Split, splits_of, splits_without
from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.hand_eye import hand_eye_is_free
from tofcorr.plausibility.inspection import Inspection
from tofcorr.training.left_out import frames_left_out, left_out_mapping, left_out_words

Metric = Literal["mean_abs_mm", "rms_mm", "rms_along_ray_mm", "rms_z_mm"]
METRICS: tuple[Metric, ...] = ("mean_abs_mm", "rms_mm", "rms_along_ray_mm", "rms_z_mm")


@dataclass(frozen=True)
class Scores:
    """The held-out errors of one protocol.

    Attributes:
        splits: The splits, S of them.
        values: For each metric and column, one value a split, shape (S,), millimetres.
        test_fraction: Share held out in each split, for the tests.
    """

    splits: list[Split]
    values: dict[Metric, dict[str, np.ndarray]]
    test_fraction: float


@dataclass(frozen=True)
class SetEvaluation:
    """All models on one set of images.

    Attributes:
        name: The set's name.
        num_frames: Images in the set.
        targets: How many images show which target.
        num_pixels: Pixels that measure the models, of all images together.
        left_out: Frames that are neither fitted nor measured, and how far off they are, as in the
            report of a training.
        hand_eye_estimated: Whether the hand-eye transform was an unknown.
        scores: The errors of each protocol that was asked for.
        hand_eye: tool_from_camera of each column, fitted to the first split's training frames.
        warnings: What limits the numbers, one sentence each.
    """

    name: str
    num_frames: int
    targets: dict[str, int]
    num_pixels: int
    hand_eye_estimated: bool
    scores: dict[Protocol, Scores]
    hand_eye: dict[str, Tensor]
    left_out: list[dict[str, Any]] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)

    def estimate(self, protocol: Protocol, metric: Metric, column: str) -> Estimate:
        """Return the mean over the splits of a protocol, with its interval, millimetres."""
        return self._over(protocol, self.scores[protocol].values[metric][column])

    def difference(self, protocol: Protocol, metric: Metric, first: str, second: str) -> Estimate:
        """Return the mean of first minus second over the splits, millimetres: a paired t-test."""
        values = self.scores[protocol].values[metric]
        return self._over(protocol, values[first] - values[second])

    def _over(self, protocol: Protocol, values: np.ndarray) -> Estimate:
        if protocol == "repeats":
            return over_repeats(values, self.scores[protocol].test_fraction)
        return over_folds(values)


def pairs(columns: list[str]) -> list[tuple[str, str]]:
    """Return the pairs of columns that are tested against each other: all but those of `before`."""
    return list(combinations([column for column in columns if column != BEFORE], 2))


def main_pairs(columns: list[str]) -> list[tuple[str, str]]:
    """Return the pairs that tables show: neighbouring columns, and each model with the first."""
    models = [column for column in columns if column not in (BEFORE, HAND_EYE_ONLY)]
    return [
        (first, second)
        for first, second in pairs(columns)
        if first == models[0] or columns.index(second) == columns.index(first) + 1
    ]


def evaluate_set(
    name: str,
    dataset: Dataset,
    options: EvaluationOptions,
    progress: Callable[[], object] | None = None,
    inspection: Inspection | None = None,
) -> SetEvaluation:
    """Fit all models to the training frames of every split, and measure the frames held out.

    Every model is measured on the same pixels: those of the recording's mask that the options'
    own masks leave.

    Args:
        name: The set's name.
        dataset: Its recordings.
        options: Models and protocols.
        progress: Called after each fit.
        inspection: What was odd about the recordings. Frames that disagree with all others are
            left out, as a training leaves them out, and garbage is met as there; None: neither.

    Raises:
        CalibrationDataError: There are too few poses for the splits, or a model needs amplitudes
            that a recording lacks.
    """
    options = options.for_recordings(dataset.recordings).against_garbage(inspection)
    protocols = splits_of(dataset, options)
    left_out: tuple[int, ...] = ()
    if inspection is not None:
        drawn = [split.train for splits in protocols.values() for split in splits]
        left_out = frames_left_out(inspection, drawn)
        for protocol, splits in protocols.items():
            protocols[protocol] = splits_without(splits, left_out)
    fitter = ModelFitter(dataset, options, progress, left_out)
    fitted: dict[Protocol, list[dict[str, FittedModel]]] = {
        protocol: [_columns(fitter, split, options) for split in splits]
        for protocol, splits in protocols.items()
    }
    targets, counts = np.unique(dataset.targets, return_counts=True)
    return SetEvaluation(
        name=name,
        num_frames=dataset.num_frames,
        targets=dict(zip(targets.tolist(), counts.tolist(), strict=True)),
        num_pixels=fitter.num_pixels,
        hand_eye_estimated=hand_eye_is_free(dataset, options.hand_eye),
        scores=_scores(fitter.measured, protocols, fitted, options),
        hand_eye={
            column: one.model.hand_eye().detach() for column, one in fitted["half"][0].items()
        },
        left_out=[] if inspection is None else left_out_mapping(left_out, inspection),
        warnings=[*left_out_words(left_out), *fitter.warnings],
    )


def _columns(
    fitter: ModelFitter, split: Split, options: EvaluationOptions
) -> dict[str, FittedModel]:
    """Return the model of every column, fitted to the training frames of a split."""
    columns = {
        BEFORE: fitter.before(split.train, split.test),
        HAND_EYE_ONLY: fitter.hand_eye_only(split.train, split.test, HAND_EYE_ONLY),
    }
    return columns | {
        model.name: fitter.fit(model, split.train, split.test) for model in options.models
    }


def _scores(
    dataset: Dataset,
    protocols: dict[Protocol, list[Split]],
    fitted: dict[Protocol, list[dict[str, FittedModel]]],
    options: EvaluationOptions,
) -> dict[Protocol, Scores]:
    """Measure the models of all protocols in one pass, and sort the errors by column."""
    in_a_row = [one for splits in fitted.values() for split in splits for one in split.values()]
    measured = iter(held_out_errors(dataset, in_a_row, options.device))
    scores: dict[Protocol, Scores] = {}
    for protocol, splits in fitted.items():
        errors = [{column: next(measured) for column in split} for split in splits]
        by_column = {
            column: _by_metric([split[column] for split in errors]) for column in options.columns
        }
        values: dict[Metric, dict[str, np.ndarray]] = {
            metric: {column: found[metric] for column, found in by_column.items()}
            for metric in METRICS
        }
        held_out = options.repeats if protocol == "repeats" else options
        scores[protocol] = Scores(protocols[protocol], values, held_out.test_fraction)
    return scores


def _by_metric(errors: list[HeldOutErrors]) -> dict[Metric, np.ndarray]:
    """Return each metric's value in every split, shape (S,), millimetres."""
    return {
        "mean_abs_mm": np.array([one.to_plane.mean_abs_mm() for one in errors]),
        "rms_mm": np.array([one.to_plane.rms_mm() for one in errors]),
        "rms_along_ray_mm": np.array([one.along_ray.rms_mm() for one in errors]),
        "rms_z_mm": np.array([one.in_z.rms_mm() for one in errors]),
    }
