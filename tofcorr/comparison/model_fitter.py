"""The models of a comparison, fitted to some of a data set's frames as a training would fit them.

No held-out image takes part in a fit: moments are those of the training frames; noise, robust
weights, estimated walls and a model's own outlier window are found in the training frames alone;
the other masks look at one image at a time. Only two things are found once in all frames: the
ranges that scale a term's variable and place a curve's knots, and the masks common to all models,
which say which pixels the comparison is about.
"""

from collections.abc import Callable, Collection
from typing import NamedTuple

import numpy as np
from torch import Tensor

from tofcorr.comparison.compared_models import ComparedModel
from tofcorr.comparison.comparison_options import ComparisonOptions, masks_of
from tofcorr.comparison.evaluation_options import BEFORE
from tofcorr.comparison.held_out_errors import FittedModel, ToolPlanes, planes_of
from tofcorr.comparison.shared_moments import moments_of_models
from tofcorr.correction.model import CalibrationModel
from tofcorr.error_terms.model import ErrorModel
from tofcorr.error_terms.model_options import ErrorModelOptions
from tofcorr.estimation.moments import ImageMoments
from tofcorr.estimation.parameters import Parameters
from tofcorr.estimation.planes import estimate_walls
from tofcorr.fit.assemble import calibrated
from tofcorr.fit.core import minimise
from tofcorr.fit.fitting import fit
from tofcorr.fit.inputs import refuse_missing_inputs
from tofcorr.fit.start import Start
from tofcorr.fit.unknown_walls import FoundWalls, name_walls, recorded_walls
from tofcorr.fit.walls_alone import walls_alone, with_every_wall
from tofcorr.fit.weighting import first_weights
from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.domain import covered_domain
from tofcorr.pixels.hand_eye import recorded_hand_eye
from tofcorr.pixels.masks import MaskOptions, usable_pixels
from tofcorr.training.options import TrainingOptions

_GEOMETRY = ""
"""Key of the model without terms, whose moments hold the geometry; no model has this name."""


class _Pass(NamedTuple):
    """What models must have in common to share a pass over the pixels.

    Attributes:
        masks: Which pixels are used.
        noise: Whether pixels are weighted by their noise.
    """

    masks: MaskOptions
    noise: bool


class ModelFitter:
    """Fits the models of a comparison.

    Args:
        dataset: The recordings.
        options: Models, masks, hand-eye, solver and device.
        progress: Called after each fit of a model.
        left_out: Global numbers of frames that no fit uses and no error measures.

    Attributes:
        measured: The data set with the pixels that measure every model: the common masks.
        domain: The ranges that scale the models' variables, of all measured pixels.
        num_pixels: How many of its pixels measure, of all frames together.
        warnings: A sentence for each fit that did not converge, or lacks a held-out wall.

    Raises:
        CalibrationDataError: A model needs what a recording lacks, or no pixel is usable.
    """

    def __init__(
        self,
        dataset: Dataset,
        options: ComparisonOptions,
        progress: Callable[[], object] | None = None,
        left_out: Collection[int] = (),
    ) -> None:
        self._dataset, self._options, self._progress = dataset, options, progress
        used = np.setdiff1d(np.arange(dataset.num_frames), list(left_out))
        self._trainings = {model.name: options.training(model) for model in options.models}
        self._common = _Pass(masks_of(options), noise=False)
        self.measured = usable_pixels(dataset, options, robust=False)
        self.domain = covered_domain(self.measured, used)
        self.warnings: list[str] = []
        self._of_all_frames: dict[_Pass, dict[str, ImageMoments]] = {}
        self._of_split: dict[_Pass, dict[str, ImageMoments]] = {}
        self._split = np.zeros(0, dtype=np.int64)
        for training in self._trainings.values():
            refuse_missing_inputs(dataset, training.model)
        self.num_pixels = int(self._moments(self._common, used, _GEOMETRY).count.sum())

    def fit(self, model: ComparedModel, train: np.ndarray, held_out: np.ndarray) -> FittedModel:
        """Fit one model to training frames, to be measured on held-out ones (global numbers)."""
        training = self._trainings[model.name]
        moments = None
        if training.weights.robust == "none":
            shared = _Pass(masks_of(training), training.weights.noise)
            moments = self._moments(shared, train, model.name)
        dataset = self._usable(training, train)
        found = fit(dataset, train, training, self.domain, moments=moments)
        if not found.solution.converged:
            self.warnings.append(
                f"{model.name}, fitted to {len(train)} frames: {found.solution.message}"
            )
        if self._progress is not None:
            self._progress()
        planes = self._judged_against(found.walls, model.name, held_out, found.model)
        return FittedModel(found.model, held_out, planes)

    def before(self, train: np.ndarray, held_out: np.ndarray) -> FittedModel:
        """Return the recorded hand-eye transform without depth correction.

        Planes that were estimated in the depth are estimated anew, in the training images.
        """
        model = self._without_correction(recorded_hand_eye(self._dataset))
        found = None
        if self._dataset.planes_are_estimated:
            found = walls_alone(self.measured, name_walls(self._dataset), train, model)
        return FittedModel(model, held_out, self._judged_against(found, BEFORE, held_out, model))

    def hand_eye_only(self, train: np.ndarray, held_out: np.ndarray, name: str) -> FittedModel:
        """Fit the hand-eye transform alone: to the common pixels, all of the same weight."""
        options = self._options
        geometry = self._moments(self._common, train, _GEOMETRY).columns([])
        start = Start.of(self.measured, options.hand_eye)(geometry)
        best = minimise(geometry, start, options.solver).parameters
        found = None
        if options.planes == "unknown":
            named = name_walls(self._dataset)
            walls, numbers = recorded_walls(self._dataset, train, named)
            best, walls = estimate_walls(geometry, best, walls)
            found = FoundWalls(named, walls, numbers)
        model = self._without_correction(best.tool_from_camera)
        return FittedModel(model, held_out, self._judged_against(found, name, held_out, model))

    def _usable(self, training: TrainingOptions, train: np.ndarray) -> Dataset:
        """Return the data set with the pixels that a model is fitted to."""
        robust = training.weights.robust != "none"
        if masks_of(training) == self._common.masks:
            # The window of the common masks is already there, and must not be centred again.
            return usable_pixels(self.measured, MaskOptions(), robust=robust)
        return usable_pixels(self._dataset, training, robust=robust, frames=train)

    def _moments(self, shared: _Pass, train: np.ndarray, name: str) -> ImageMoments:
        """Return a model's moments of the training frames, from a pass over the pixels or kept."""
        own_window = shared.masks != self._common.masks and shared.masks.outlier_window_mm
        if not own_window and not shared.noise:
            if shared not in self._of_all_frames:
                self._of_all_frames[shared] = self._pass(
                    shared, np.arange(self._dataset.num_frames)
                )
            return self._of_all_frames[shared][name].images(train.tolist())
        if not np.array_equal(self._split, train):
            self._of_split, self._split = {}, train
        if shared not in self._of_split:
            self._of_split[shared] = self._pass(shared, train)
        return self._of_split[shared][name]

    def _pass(self, shared: _Pass, frames: np.ndarray) -> dict[str, ImageMoments]:
        """Read the pixels of the frames once for all models that share masks and weights."""
        trainings = {
            name: training
            for name, training in self._trainings.items()
            if training.weights.robust == "none"
            and _Pass(masks_of(training), training.weights.noise) == shared
        }
        models = {name: training.model for name, training in trainings.items()}
        dataset = self.measured
        if shared == self._common:
            models = {_GEOMETRY: ErrorModelOptions()} | models
        else:
            dataset = self._usable(next(iter(trainings.values())), frames)
        weights = first_weights(dataset, frames, noise=True, loss="none") if shared.noise else None
        return moments_of_models(
            dataset, models, self.domain, self._options.device, frames=frames, weighting=weights
        )

    def _judged_against(
        self, found: FoundWalls | None, name: str, held_out: np.ndarray, model: CalibrationModel
    ) -> ToolPlanes | None:
        """Return the planes for the held-out frames; None: those recorded."""
        if found is None or self._options.planes == "known":
            return None
        if self._dataset.planes_are_estimated:
            return planes_of(with_every_wall(self.measured, found, model))
        unseen = set(found.named.of_frame[held_out].tolist()) - set(found.numbers.tolist())
        for wall in sorted(unseen):
            self.warnings.append(
                f"{name}: no training image shows the wall '{found.named.names[wall]}'; its "
                "held-out images are judged against the recorded plane."
            )
        return planes_of(found.put_into(self._dataset))

    def _without_correction(self, tool_from_camera: Tensor) -> CalibrationModel:
        nothing = ErrorModel(ErrorModelOptions(), self.domain)
        known = Parameters(tool_from_camera, nothing.coefficient_vector(), hand_eye_is_free=False)
        return calibrated(nothing, known)
