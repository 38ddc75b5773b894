"""The experiment of `evaluate` and `select`: models measured on frames not fitted to.

No held-out image takes part in a fit: moments are those of the training frames; noise, robust
weights, estimated walls and a model's own outlier window are found in the training frames alone;
the other masks look at one image at a time. Only two things are found once in all frames: the
ranges that scale a term's variable and place a curve's knots, and the masks common to all models,
which say which pixels the comparison is about.
"""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tofcorr.comparison.options import BEFORE, ComparedModel, ComparisonOptions, masks_of
from tofcorr.comparison.splits import Splits, without_frames
from tofcorr.correction.model import CalibrationModel
from tofcorr.data.recording import planes_in_tool
from tofcorr.error_terms.model import ErrorModel, ErrorModelOptions, Pixels
from tofcorr.estimation.moments import ImageMoments, Parameters
from tofcorr.estimation.planes import estimate_walls
from tofcorr.fit.core import minimise
from tofcorr.fit.fitting import calibrated, fit
from tofcorr.fit.problem import Start, build_model, refuse_missing_inputs
from tofcorr.fit.walls import FoundWalls, name_walls, recorded_walls, walls_alone, with_every_wall
from tofcorr.pixels.dataset import Dataset, covered_domain, recorded_hand_eye
from tofcorr.pixels.metrics import FrameErrors
from tofcorr.pixels.sample import MaskOptions, pixels_of_image, usable_pixels
from tofcorr.plausibility.finding import Inspection
from tofcorr.training.judgement import frames_left_out, left_out_mapping, left_out_words
from tofcorr.training.options import TrainingOptions

KINDS = ("to_plane", "along_ray", "in_z")
"""Kinds of error: the distance of the corrected points to the target's plane, which is what is
fitted; corrected minus true distance along the viewing ray, larger at oblique rays; corrected minus
true depth along the optical axis, at the same ray."""


@dataclass(frozen=True)
class FittedModel:
    """A model fitted to training frames, and what measures it.

    Attributes:
        model: Error model and hand-eye transform.
        held_out: Global numbers of the frames that measure it.
        planes: The data set whose planes it is judged against; None: that which measures it.
    """

    model: CalibrationModel
    held_out: np.ndarray
    planes: Dataset | None = None


@dataclass(frozen=True)
class Experiment:
    """Models, each measured on frames that it was not fitted to.

    Attributes:
        splits: What was fitted and held out.
        models: By split as in `splits`, and by column.
        errors: The same of their errors on the frames held out, by kind.
        fitter: What fitted them, and the pixels that measure them.
        left_out: Frames that are neither fitted nor measured, and how far off they are, as in the
            report of a training.
        warnings: What limits the numbers, one sentence each.
    """

    splits: Splits
    models: list[dict[str, FittedModel]]
    errors: dict[str, list[dict[str, dict[str, FrameErrors]]]]
    fitter: "ModelFitter"
    left_out: list[dict[str, Any]]
    warnings: list[str]


def held_out_experiment(
    dataset: Dataset,
    options: ComparisonOptions,
    splits: Splits,
    inspection: Inspection | None,
    progress: Callable[[], object] | None = None,
    baselines: Sequence[str] = (),
) -> Experiment:
    """Fit all models to the training frames of every split, and measure the frames held out.

    Every model is measured on the same pixels: those of the recordings' masks that the options'
    own masks leave.

    Args:
        dataset: The recordings.
        options: The models.
        splits: What is fitted and held out.
        inspection: What was odd about the recordings. Frames that disagree with all others are
            left out, as a training leaves them out; None: none are.
        progress: Called after each fit.
        baselines: Headings of columns without depth correction, before those of the models.

    Raises:
        CalibrationDataError: A model needs what a recording lacks, or no pixel is usable.
    """
    left_out: tuple[int, ...] = ()
    if inspection is not None:
        drawn = [split.train for own in splits.values() for split in own.values()]
        left_out = frames_left_out(inspection, drawn)
        splits = {kind: without_frames(own, left_out) for kind, own in splits.items()}
    fitter = ModelFitter(dataset, options, progress, left_out)
    models = [
        {name: fitter.bare(name, *split) for name in baselines}
        | {model.name: fitter.fit(model, *split) for model in options.models}
        for own in splits.values()
        for split in own.values()
    ]
    in_a_row = [one for columns in models for one in columns.values()]
    found = iter(held_out_errors(fitter.measured, in_a_row, options.device))
    by_split = iter([{column: next(found) for column in columns} for columns in models])
    return Experiment(
        splits=splits,
        models=models,
        errors={kind: [next(by_split) for _ in own] for kind, own in splits.items()},
        fitter=fitter,
        left_out=[] if inspection is None else left_out_mapping(left_out, inspection),
        warnings=[*left_out_words(left_out), *fitter.warnings],
    )


class ModelFitter:
    """Fits the models of a comparison to some of a data set's frames, as a training would.

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
        self.measured = usable_pixels(dataset, options, robust=False)
        self.domain = covered_domain(self.measured, used)
        self.warnings: list[str] = []
        self._of_all_frames: dict[str, ImageMoments] = {}
        for training in self._trainings.values():
            refuse_missing_inputs(dataset, training.model)
        self._geometry = self._moments(self.measured, ErrorModelOptions())
        self.num_pixels = int(self._geometry.images(used.tolist()).count.sum())

    def fit(self, model: ComparedModel, train: np.ndarray, held_out: np.ndarray) -> FittedModel:
        """Fit one model to training frames, to be measured on held-out ones (global numbers)."""
        training = self._trainings[model.name]
        dataset, moments = self._usable(training, train), None
        own_window = masks_of(training) != masks_of(self._options) and training.outlier_window_mm
        if not (training.weights.noise or training.weights.robust != "none" or own_window):
            # The pixels are those of any other split: they are read once.
            if model.name not in self._of_all_frames:
                self._of_all_frames[model.name] = self._moments(dataset, training.model)
            moments = self._of_all_frames[model.name].images(train.tolist())
        found = fit(dataset, train, training, self.domain, moments=moments)
        if not found.solution.converged:
            self.warnings.append(
                f"{model.name}, fitted to {len(train)} frames: {found.solution.message}"
            )
        if self._progress is not None:
            self._progress()
        planes = self._judged_against(found.walls, model.name, held_out, found.model)
        return FittedModel(found.model, held_out, planes)

    def bare(self, name: str, train: np.ndarray, held_out: np.ndarray) -> FittedModel:
        """Return a hand-eye transform without depth correction.

        `BEFORE`: the recorded one; planes that were estimated in the depth are estimated again, in
        the training images. Else it is fitted alone: to the common pixels, all of the same weight.
        """
        found = None
        if name == BEFORE:
            model = self._without_correction(recorded_hand_eye(self._dataset))
            if self._dataset.planes_are_estimated:
                found = walls_alone(self.measured, name_walls(self._dataset), train, model)
        else:
            moments = self._geometry.images(train.tolist()).columns([])
            start = Start.of(self.measured, self._options.hand_eye)(moments)
            best = minimise(moments, start, self._options.solver).parameters
            if self._options.planes == "unknown":
                named = name_walls(self._dataset)
                walls, numbers = recorded_walls(self._dataset, train, named)
                best, walls = estimate_walls(moments, best, walls)
                found = FoundWalls(named, walls, numbers)
            model = self._without_correction(best.tool_from_camera)
        return FittedModel(model, held_out, self._judged_against(found, name, held_out, model))

    def _usable(self, training: TrainingOptions, train: np.ndarray) -> Dataset:
        """Return the data set with the pixels that a model is fitted to."""
        robust = training.weights.robust != "none"
        if masks_of(training) == masks_of(self._options):
            # The window of the common masks is already there, and must not be centred again.
            return usable_pixels(self.measured, MaskOptions(), robust=robust)
        return usable_pixels(self._dataset, training, robust=robust, frames=train)

    def _moments(self, dataset: Dataset, model: ErrorModelOptions) -> ImageMoments:
        """Return a model's moments of all frames."""
        _, design = build_model(dataset, model, self.domain)
        return dataset.moments(design, device=self._options.device)

    def _judged_against(
        self, found: FoundWalls | None, name: str, held_out: np.ndarray, model: CalibrationModel
    ) -> Dataset | None:
        """Return the data set with the planes for the held-out frames; None: those recorded."""
        if found is None or self._options.planes == "known":
            return None
        if self._dataset.planes_are_estimated:
            return with_every_wall(self.measured, found, model)
        unseen = set(found.named.of_frame[held_out].tolist()) - set(found.numbers.tolist())
        for wall in sorted(unseen):
            self.warnings.append(
                f"{name}: no training image shows the wall '{found.named.names[wall]}'; its "
                "held-out images are judged against the recorded plane."
            )
        return found.put_into(self._dataset)

    def _without_correction(self, tool_from_camera: Tensor) -> CalibrationModel:
        nothing = ErrorModel(ErrorModelOptions(), self.domain)
        known = Parameters(tool_from_camera, nothing.coefficient_vector(), hand_eye_is_free=False)
        return calibrated(nothing, known)


def held_out_errors(
    dataset: Dataset, fitted: Sequence[FittedModel], device: str = "cpu"
) -> list[dict[str, FrameErrors]]:
    """Measure every model on its held-out frames, all in one pass over the pixels.

    Args:
        dataset: The recordings, with the masks that choose the pixels to measure on.
        fitted: The models. All that hold out a frame are measured on the same pixels of it.
        device: Where to compute.

    Returns:
        The errors by kind, in the order of the models.
    """
    rays = dataset.ray_directions().reshape(-1, 3).to(device)
    models = [one.model.to(device) for one in fitted]
    planes = [_planes_in_tool(one.planes or dataset) for one in fitted]
    frames = [set(one.held_out.tolist()) for one in fitted]
    sums: list[dict[int, Tensor]] = [{} for _ in fitted]
    for batch in dataset.batches(np.unique(np.concatenate([f.held_out for f in fitted])), device):
        for k, frame in enumerate(batch.indices.tolist()):
            used = batch.valid[k].reshape(-1).nonzero()[:, 0]
            pixels = pixels_of_image(batch, k, used)
            for model, own, plane, found in zip(models, frames, planes, sums, strict=True):
                if frame in own:
                    found[frame] = _error_sums(model, pixels, rays[used], plane[frame].to(device))
    return [_by_kind(found) for found in sums]


def _planes_in_tool(dataset: Dataset) -> Tensor:
    """Return the planes n . x + d = 0 of a data set's frames in the tool frame, (N, 4)."""
    planes = [planes_in_tool(recording) for recording in dataset.recordings]
    return torch.cat([torch.cat([normal, d[:, None]], dim=1) for normal, d in planes])


@torch.no_grad()
def _error_sums(model: CalibrationModel, pixels: Pixels, rays: Tensor, plane: Tensor) -> Tensor:
    """Return |error| and error^2 of the three kinds, summed, and the number of pixels: (7,)."""
    corrected = pixels.radial_distance - model.error.error_at(pixels)
    plane_in_camera = plane.to(corrected) @ model.hand_eye()
    cosine = rays @ plane_in_camera[:3]
    to_plane = cosine * corrected + plane_in_camera[3]
    along_ray = to_plane / cosine
    kinds = torch.stack([to_plane, along_ray, along_ray * rays[:, 2]])
    sums = torch.stack([kinds.abs().sum(1), kinds.square().sum(1)], dim=1)
    return torch.cat([sums.flatten(), sums.new_tensor([len(rays)])]).cpu()


def _by_kind(sums: dict[int, Tensor]) -> dict[str, FrameErrors]:
    frames = np.array(list(sums), dtype=np.int64)
    rows = torch.stack(list(sums.values()), dim=1).numpy() if sums else np.zeros((7, 0))
    return {
        kind: FrameErrors(frames, rows[2 * k], rows[2 * k + 1], rows[6])
        for k, kind in enumerate(KINDS)
    }
