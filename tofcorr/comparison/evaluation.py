"""Compares models on frames that they were not fitted to, as Abdo and Borgeat (2010) do.

Three protocols share one machinery: a random half split (the paper's Table 1), k-fold
cross-validation by image (Table 2) and repeated random splits. Each is a list of splits. All
models of all splits are fitted from one set of moments and measured in one pass over the pixels.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path
from typing import Literal

import numpy as np
from torch import Tensor

from tofcorr.comparison.evaluation_options import BEFORE, HAND_EYE_ONLY, EvaluationOptions
from tofcorr.comparison.model_fitter import ModelFitter
from tofcorr.comparison.statistics import Estimate, over_folds, over_repeats
from tofcorr.comparison.trials import Trial, measure
from tofcorr.comparison.union import moments_of_models
from tofcorr.correction.model import CalibrationModel
from tofcorr.error_terms.model import ErrorModel, ErrorModelOptions
from tofcorr.estimation.parameters import Parameters
from tofcorr.fit.assemble import calibrated
from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.domain import covered_domain
from tofcorr.pixels.hand_eye import hand_eye_is_free, recorded_hand_eye
from tofcorr.pixels.outliers import without_outliers
from tofcorr.pixels.split import SplitOptions, folds, split_frames

Protocol = Literal["half", "folds", "repeats"]
Metric = Literal["mean_abs_mm", "rms_mm", "rms_along_ray_mm", "rms_z_mm"]
METRICS: tuple[Metric, ...] = ("mean_abs_mm", "rms_mm", "rms_along_ray_mm", "rms_z_mm")


@dataclass(frozen=True)
class Split:
    """Frames to fit, and frames to measure on (global numbers)."""

    train: np.ndarray
    test: np.ndarray


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
        num_pixels: Pixels used, of all images together.
        hand_eye_estimated: Whether the hand-eye transform was an unknown.
        scores: The errors of each protocol that was asked for.
        hand_eye: tool_from_camera of each column, fitted to the first split's training frames.
        warnings: What a reader must know, one sentence each.
    """

    name: str
    num_frames: int
    targets: dict[str, int]
    num_pixels: int
    hand_eye_estimated: bool
    scores: dict[Protocol, Scores]
    hand_eye: dict[str, Tensor]
    warnings: list[str] = field(default_factory=list)

    def estimate(self, protocol: Protocol, metric: Metric, column: str) -> Estimate:
        """Return the mean over the splits of a protocol, with its interval."""
        return _over(self, protocol, self.scores[protocol].values[metric][column])

    def difference(self, protocol: Protocol, metric: Metric, first: str, second: str) -> Estimate:
        """Return the mean of first minus second over the splits: a paired t-test."""
        values = self.scores[protocol].values[metric]
        return _over(self, protocol, values[first] - values[second])


def _over(evaluation: SetEvaluation, protocol: Protocol, values: np.ndarray) -> Estimate:
    if protocol == "repeats":
        return over_repeats(values, evaluation.scores[protocol].test_fraction)
    return over_folds(values)


def pairs(columns: list[str]) -> list[tuple[str, str]]:
    """Return the pairs of columns that are tested against each other: all but those of `before`."""
    return list(combinations([column for column in columns if column != BEFORE], 2))


def main_pairs(columns: list[str]) -> list[tuple[str, str]]:
    """Return the pairs worth a line: neighbouring columns, and each model with the first."""
    models = [column for column in columns if column not in (BEFORE, HAND_EYE_ONLY)]
    return [
        (first, second)
        for first, second in pairs(columns)
        if first == models[0] or columns.index(second) == columns.index(first) + 1
    ]


def set_names(paths: Sequence[Path | str]) -> list[str]:
    """Return what to call recordings: their folders' names, numbered where two are alike."""
    names = [Path(path).resolve().name for path in paths]
    return [
        name if names.count(name) == 1 else f"{name} ({k})" for k, name in enumerate(names, start=1)
    ]


def num_fits(options: EvaluationOptions) -> int:
    """Return how many fits the evaluation of one set takes, for a progress bar."""
    return (1 + options.folds + options.repeats.number) * len(options.models)


def evaluate(
    name: str,
    dataset: Dataset,
    options: EvaluationOptions,
    progress: Callable[[], object] | None = None,
) -> SetEvaluation:
    """Fit all models of all splits of one set, and measure them on the frames held out.

    Args:
        name: What to call the set.
        dataset: Its recordings.
        options: Models and protocols.
        progress: Called after each fit.

    Raises:
        CalibrationDataError: There are too few poses for the splits, or a model needs amplitudes
            that a recording lacks.
    """
    dataset = without_outliers(dataset, options.outlier_window_mm)
    everything = np.arange(dataset.num_frames)
    # The domain only scales variables and bounds curves, so it may see the frames held out.
    domain = covered_domain(dataset, everything)
    models = {model.name: model.model for model in options.models}
    moments = moments_of_models(dataset, models, domain, options.device)
    protocols = _splits(dataset, options)
    fitter = _Columns(dataset, domain, moments, options, progress)
    trials: dict[Protocol, list[dict[str, Trial]]] = {
        protocol: [fitter.trials(split) for split in splits]
        for protocol, splits in protocols.items()
    }
    scores = _scores(dataset, protocols, trials, options)
    targets, counts = np.unique(dataset.targets, return_counts=True)
    return SetEvaluation(
        name=name,
        num_frames=dataset.num_frames,
        targets=dict(zip(targets.tolist(), counts.tolist(), strict=True)),
        num_pixels=int(next(iter(moments.values())).count.sum()),
        hand_eye_estimated=hand_eye_is_free(dataset, options.hand_eye),
        scores=scores,
        hand_eye={
            column: trial.model.hand_eye().detach() for column, trial in trials["half"][0].items()
        },
        warnings=fitter.warnings,
    )


def _scores(
    dataset: Dataset,
    protocols: dict[Protocol, list[Split]],
    trials: dict[Protocol, list[dict[str, Trial]]],
    options: EvaluationOptions,
) -> dict[Protocol, Scores]:
    """Measure the trials of all protocols in one pass, and sort the results by column."""
    in_a_row = [trial for splits in trials.values() for split in splits for trial in split.values()]
    measured = iter(measure(dataset, in_a_row, options.device))
    scores: dict[Protocol, Scores] = {}
    for protocol, splits in trials.items():
        errors = [{column: next(measured) for column in split} for split in splits]
        values: dict[Metric, dict[str, np.ndarray]] = {metric: {} for metric in METRICS}
        for column in options.columns:
            own = [split[column] for split in errors]
            values["mean_abs_mm"][column] = np.array([e.to_plane.mean_abs_mm() for e in own])
            values["rms_mm"][column] = np.array([e.to_plane.rms_mm() for e in own])
            values["rms_along_ray_mm"][column] = np.array([e.along_ray.rms_mm() for e in own])
            values["rms_z_mm"][column] = np.array([e.in_z.rms_mm() for e in own])
        held_out = options.repeats if protocol == "repeats" else options
        scores[protocol] = Scores(protocols[protocol], values, held_out.test_fraction)
    return scores


def _splits(dataset: Dataset, options: EvaluationOptions) -> dict[Protocol, list[Split]]:
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


class _Columns(ModelFitter):
    """The models of every column of the tables, fitted to the training frames of a split."""

    def trials(self, split: Split) -> dict[str, Trial]:
        """Return every column's model, to be measured on the frames held out."""
        fits = {model.name: self.fit(model, split.train) for model in self._options.models}
        geometry = next(iter(fits.values())).hand_eye_only.tool_from_camera
        bare = {BEFORE: recorded_hand_eye(self._dataset), HAND_EYE_ONLY: geometry}
        models = {name: self._without_correction(transform) for name, transform in bare.items()}
        models |= {name: fitted.model for name, fitted in fits.items()}
        return {name: Trial(model, split.test) for name, model in models.items()}

    def _without_correction(self, tool_from_camera: Tensor) -> CalibrationModel:
        nothing = ErrorModel(ErrorModelOptions(), self._domain)
        known = Parameters(tool_from_camera, nothing.coefficient_vector(), hand_eye_is_free=False)
        return calibrated(nothing, known)
