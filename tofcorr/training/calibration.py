"""The options of a training, and its computation: split the frames, fit, measure the errors."""

from collections.abc import Collection
from dataclasses import replace
from typing import ClassVar

import numpy as np
from pydantic import NonNegativeInt
from torch import Tensor

from tofcorr.correction.model import CalibrationModel
from tofcorr.error_terms.base import Domain
from tofcorr.error_terms.model import ErrorModel, ErrorModelOptions
from tofcorr.estimation.moments import Parameters
from tofcorr.estimation.solvers import Watcher
from tofcorr.fit.fitting import calibrated, fit
from tofcorr.fit.known import PriorKnowledge
from tofcorr.fit.misfit import assumptions, find_misfit, misfit_pixels
from tofcorr.fit.problem import Fit, FitOptions
from tofcorr.fit.walls import with_every_wall
from tofcorr.pixels.dataset import (
    Dataset,
    SplitOptions,
    recorded_hand_eye,
    split_frames,
    thread_number,
)
from tofcorr.pixels.lattice import covered_domain, lattice_of
from tofcorr.pixels.passes import frame_errors
from tofcorr.pixels.sample import MaskOptions
from tofcorr.training.scene import RuntimeOptions


class TrainingOptions(FitOptions, MaskOptions):
    """All options of `tofcorr.train` and `tofcorr train`: the fit, the pixels used, and the split.

    Attributes:
        name: The model's name in reports.
        split: The frames held out.
        advice: For how many further poses the report gives advice; 0: for none.
        figures: Whether a page is written, and TensorBoard is given figures; the numbers of the fit
            it gets anyway.
        runtime: What the corrector finds in a frame besides.
    """

    config_folder: ClassVar[str] = "train"

    name: str
    split: SplitOptions = SplitOptions()
    advice: NonNegativeInt = 5
    figures: bool = True
    runtime: RuntimeOptions = RuntimeOptions()


class Calibration:
    """A fitted model and its errors on the frames fitted and held out.

    The frames are split, and the model is fitted to one half and measured on both.

    Args:
        data: The recordings, without the pixels that the options leave out.
        options: Model, split, solver and device.
        watcher: Called after each iteration of the solver; returning False ends it.
        resumed: Where an interrupted run stood; None starts anew.
        left_out: Global numbers of frames that are neither fitted nor held out.
        known: What earlier calibrations say, for the ranges of the fit; None: nothing.
        found: The fit, where it was made together with other cameras; the recordings then have the
            walls and poses that it found.

    Raises:
        CalibrationDataError: The recordings cannot support the model.

    Attributes:
        data: The recordings; estimated walls stand in place of the recorded ones.
        fit: The fitted model.
        train: Global numbers of the frames fitted, shape (N,), increasing.
        test: Global numbers of the frames held out, increasing; may be empty.
        stages: The models that the report compares: `before` any correction, with the recorded
            hand-eye; `hand_eye_only`; `after`, the fitted model.
        errors: The errors of each stage on all frames.
        kinds: Those of the fitted model by kind, see `tofcorr.pixels.passes.KINDS`.
    """

    def __init__(
        self,
        data: Dataset,
        options: TrainingOptions,
        watcher: Watcher | None = None,
        resumed: Parameters | None = None,
        left_out: Collection[int] = (),
        known: PriorKnowledge | None = None,
        found: Fit | None = None,
    ) -> None:
        self.train, self.test = halves(data, options, left_out)
        if found is None:
            lattice = lattice_of(data, self.train)
            domain = covered_domain(data, self.train, lattice) if known is None else known.domain
            found = fit(
                data, self.train, options, known or domain, watcher, resumed, lattice=lattice
            )
        self.data = data = with_every_wall(data, found.walls, found.model)
        self.stages = {
            "before": without_correction(found.domain, recorded_hand_eye(data)),
            "hand_eye_only": without_correction(found.domain, found.hand_eye_only.tool_from_camera),
            "after": found.model,
        }
        every = frame_errors(data, self.stages, options.device, found.observability.variance)
        self.errors = {stage: own["to_plane"] for stage, own in every.items()}
        self.kinds = every["after"]
        if found.solution.parameters.hand_eye_is_free:
            with thread_number(1):
                seen = misfit_pixels(data, found, self.frames)
                if seen is not None:
                    assumed, misfit = assumptions(seen, found), find_misfit(seen, found)
                    found = replace(found, misfit=misfit, assumptions=assumed)
        self.fit = found

    @property
    def tested(self) -> np.ndarray:
        """Global numbers of the frames held out; of those fitted, if none is."""
        return self.test if len(self.test) else self.train

    @property
    def frames(self) -> np.ndarray:
        """Global numbers of all frames used, fitted or held out, increasing."""
        return np.sort(np.concatenate([self.train, self.test]))


def halves(
    data: Dataset, options: TrainingOptions, left_out: Collection[int]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the global numbers of the frames to fit, and of those held out."""
    train, test = split_frames(data, options.split)
    return train[~np.isin(train, list(left_out))], test[~np.isin(test, list(left_out))]


def without_correction(domain: Domain, tool_from_camera: Tensor) -> CalibrationModel:
    """Return a hand-eye transform without any depth correction."""
    nothing = ErrorModel(ErrorModelOptions(), domain)
    zero = nothing.coefficient_vector()
    return calibrated(nothing, Parameters(tool_from_camera, zero, hand_eye_is_free=False))
