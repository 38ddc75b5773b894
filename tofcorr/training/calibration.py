"""The computation of a training: split the frames, fit the model, measure its errors."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace

import numpy as np
from torch import Tensor

from tofcorr.correction.model import CalibrationModel, HandEye
from tofcorr.error_terms.base import Domain
from tofcorr.error_terms.model import ErrorModel, ErrorModelOptions
from tofcorr.estimation.moments import Parameters
from tofcorr.estimation.solvers import Watcher
from tofcorr.fit.fitting import fit
from tofcorr.fit.misfit import assumptions, find_misfit, misfit_pixels
from tofcorr.fit.result import Fit
from tofcorr.pixels.dataset import (
    Dataset,
    covered_domain,
    recorded_hand_eye,
    split_frames,
    thread_number,
)
from tofcorr.pixels.metrics import FrameErrors, frame_errors
from tofcorr.training.options import TrainingOptions


@dataclass(frozen=True, kw_only=True, eq=False)
class Calibration:
    """A fitted model and its errors on the frames fitted and held out.

    Attributes:
        data: The recordings; estimated walls stand in place of the recorded ones.
        fit: The fitted model.
        train: Global numbers of the frames fitted, shape (N,), increasing.
        test: Global numbers of the frames held out, increasing; may be empty.
        stages: The models that the report compares: `before` any correction, with the recorded
            hand-eye; `hand_eye_only`; `after`, the fitted model.
        errors: The errors of each stage on all frames.
    """

    data: Dataset
    fit: Fit
    train: np.ndarray
    test: np.ndarray
    stages: Mapping[str, CalibrationModel]
    errors: Mapping[str, FrameErrors]


def calibrate(
    data: Dataset,
    options: TrainingOptions,
    watcher: Watcher | None = None,
    resumed: Parameters | None = None,
    left_out: Collection[int] = (),
) -> Calibration:
    """Split the frames, fit the model to one half and measure it on both.

    Args:
        data: The recordings, without the pixels that the options leave out.
        options: Model, split, solver and device.
        watcher: Called after each iteration of the solver; returning False ends it.
        resumed: Where an interrupted run stood; None starts anew.
        left_out: Global numbers of frames that are neither fitted nor held out.

    Raises:
        CalibrationDataError: The recordings cannot support the model.
    """
    train, test = (
        frames[~np.isin(frames, list(left_out))] for frames in split_frames(data, options.split)
    )
    domain = covered_domain(data, train)
    fitted = fit(data, train, options, domain, watcher, resumed)
    data = fitted.on_its_walls(data)
    stages = _stages(data, fitted)
    errors = frame_errors(data, stages, device=options.device)
    if fitted.solution.parameters.hand_eye_is_free:
        with thread_number(1):
            seen = misfit_pixels(data, fitted, np.sort(np.concatenate([train, test])))
            if seen is not None:
                assumed = assumptions(seen, fitted, data.first.camera)
                fitted = replace(fitted, misfit=find_misfit(seen, fitted), assumptions=assumed)
    return Calibration(data=data, fit=fitted, train=train, test=test, stages=stages, errors=errors)


def _stages(data: Dataset, fitted: Fit) -> dict[str, CalibrationModel]:
    """Return the models whose errors the report compares: before, hand-eye only, after."""
    return {
        "before": _without_correction(fitted.domain, recorded_hand_eye(data)),
        "hand_eye_only": _without_correction(fitted.domain, fitted.hand_eye_only.tool_from_camera),
        "after": fitted.model,
    }


def _without_correction(domain: Domain, tool_from_camera: Tensor) -> CalibrationModel:
    hand_eye = HandEye(fixed=True)
    hand_eye.rebase(tool_from_camera)
    return CalibrationModel(ErrorModel(ErrorModelOptions(), domain), hand_eye)
