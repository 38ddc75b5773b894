"""One fitting problem: its options, what the model needs, where to start."""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from tofcorr.error_terms.base import Domain
from tofcorr.error_terms.model import ErrorModel, ErrorModelOptions
from tofcorr.errors import CalibrationDataError
from tofcorr.estimation.accumulator import Design
from tofcorr.estimation.moments import ImageMoments, MomentObjective, Parameters
from tofcorr.estimation.solvers import SolverOptions, Watcher, initial_parameters, with_linear_part
from tofcorr.fit.residual import ResidualOptions
from tofcorr.fit.walls import FoundWalls
from tofcorr.fit.weighting import WeightOptions
from tofcorr.options import Options
from tofcorr.pixels.dataset import (
    Dataset,
    HandEyeOptions,
    PlaneChoice,
    hand_eye_is_free,
    recorded_hand_eye,
)


class FitOptions(Options):
    """How one model is fitted to given frames.

    Attributes:
        model: The terms of the error.
        residual: A small network on what the terms leave, kept if it improves held-out images;
            null: none.
        hand_eye: Whether the hand-eye transform is estimated, and where its estimate starts.
        solver: The optimiser.
        weights: The weight of each pixel.
        planes: `known`: the recorded planes are used as they are; `unknown`: every wall (frames of
            one target and one recorded plane) is estimated, from the recorded plane as a start;
            `auto`: `unknown` where `recording.yaml` says `planes: estimated`, else `known`.
        free_directions: How to treat a direction that the images do not determine: `prior` holds
            it near the start (standard deviation 100 mm, 100 mrad) and warns; `refuse` is an
            error.
        remove_noise_shift: Whether hand-eye transform and coefficients are moved back by what the
            noise of the measured distances has moved them; false leaves them where the loss is
            least.
        device: Where the pass over the pixels runs: `cpu`, `cuda`, `cuda:1`, ...
    """

    model: ErrorModelOptions
    residual: ResidualOptions | None = None
    hand_eye: HandEyeOptions = HandEyeOptions()
    solver: SolverOptions = SolverOptions()
    weights: WeightOptions = WeightOptions()
    planes: PlaneChoice = "auto"
    free_directions: Literal["prior", "refuse"] = "prior"
    remove_noise_shift: bool = True
    device: str = "cpu"


def build_model(
    dataset: Dataset, options: ErrorModelOptions, domain: Domain
) -> tuple[ErrorModel, Design]:
    """Build an error model with zero coefficients for the data set's camera, and its design.

    Raises:
        CalibrationDataError: The model needs what a recording lacks: amplitudes, the modulation
            frequency, a column of frames.csv; or its amplitudes are all the same.
    """
    refuse_missing_inputs(dataset, options)
    _refuse_one_amplitude(dataset, options, domain)
    error = ErrorModel(options, domain)
    return error, Design(error, domain, dataset.ray_directions())


_DEPTH_ALONE = (
    "`tofcorr train --config e0` needs depth alone, and so do evaluate and select with "
    "`--set 'models=[{config: e0}]'`"
)


def refuse_missing_inputs(dataset: Dataset, options: ErrorModelOptions) -> None:
    """Refuse a recording that lacks an input of a term.

    Raises:
        CalibrationDataError: An input is missing; the message names the file and the term.
    """
    for term in options.terms:
        for name in term.needs:
            try:
                dataset.require(name, f"the term {term.kind}")
            except CalibrationDataError as error:
                raise CalibrationDataError(
                    f"{error} Record it, or choose models without that term: {_DEPTH_ALONE}."
                ) from None


def _refuse_one_amplitude(dataset: Dataset, options: ErrorModelOptions, domain: Domain) -> None:
    """Refuse a term of the amplitude where that never changes: no coefficient is determined."""
    found = domain.amplitude
    if found is None or found.low < found.high:
        return
    for term in options.terms:
        if "amplitude" in term.needs:
            raise CalibrationDataError(
                f"{dataset.first.path}: amplitude.npy holds {found.low:g} in every pixel used, so "
                f"it was not measured, and the term {term.kind} needs it. Remove the file and "
                f"choose models without that term: {_DEPTH_ALONE}."
            )


@dataclass(frozen=True)
class Start:
    """Gives a start for the solver, whichever of the model's columns the moments hold.

    Attributes:
        recorded: tool_from_camera as the recording has it, shape (4, 4), float64, metres.
        hand_eye_is_free: Whether the hand-eye transform is estimated.
        tries_closed_form: Whether the closed form from plane normals is tried as well.
        resumed: Where an earlier fit stood; None starts anew.
    """

    recorded: Tensor
    hand_eye_is_free: bool
    tries_closed_form: bool
    resumed: Parameters | None = None

    @staticmethod
    def of(dataset: Dataset, options: HandEyeOptions, resumed: Parameters | None = None) -> "Start":
        """Return the start that the recordings and the options give."""
        return Start(
            recorded=recorded_hand_eye(dataset),
            hand_eye_is_free=hand_eye_is_free(dataset, options),
            tries_closed_form=options.start == "auto",
            resumed=resumed,
        )

    def resumed_at(self, parameters: Parameters | None) -> "Start":
        """Return the start at parameters found earlier; None: without any."""
        return replace(self, resumed=parameters)

    def __call__(self, moments: ImageMoments) -> Parameters:
        """Return where the solver starts on these moments.

        The resumed parameters, if there are any with as many coefficients as the moments have
        columns; otherwise the candidate of least loss.
        """
        resumed = self.resumed
        if resumed is not None and resumed.coefficients.numel() == moments.num_coefficients:
            return resumed
        candidates = [with_linear_part(moments, self.guess(moments))]
        if self.hand_eye_is_free and self.tries_closed_form:
            candidates.append(initial_parameters(moments, self.recorded))
        objective = MomentObjective(moments)
        return min(candidates, key=lambda candidate: float(objective.loss(candidate)))

    def guess(self, moments: ImageMoments) -> Parameters:
        """Return the recorded hand-eye transform and no error: the centre of the prior."""
        zero = torch.zeros(moments.num_coefficients, dtype=torch.float64)
        return Parameters(self.recorded, zero, self.hand_eye_is_free)


@dataclass(frozen=True)
class Problem:
    """Everything that the steps of a fit look at, apart from the moments.

    Attributes:
        dataset: The recordings, with the walls found once they are found.
        frames: Global numbers of the frames to fit, shape (N,).
        options: Model, hand-eye, solver and device.
        domain: The ranges that scale the model's variables.
        start: Where the solver starts.
        watcher: Called after each iteration of the solver.
        walls: The estimated walls; None as long as the recorded ones are used.
    """

    dataset: Dataset
    frames: np.ndarray
    options: FitOptions
    domain: Domain
    start: Start
    watcher: Watcher | None = None
    walls: FoundWalls | None = None

    def conditions(self) -> Tensor:
        """Return the frames' conditions, shape (N, C) in the order of `CONDITIONS`."""
        return self.dataset.conditions(self.frames)

    def poses(self) -> np.ndarray:
        """Return the pose of each frame, shape (N,): integers, the same for frames of one pose."""
        return self.dataset.pose_groups()[self.frames]

    def numbered_poses(self) -> Tensor:
        """Return the pose of each frame, shape (N,), numbered from zero without gaps."""
        return torch.from_numpy(np.unique(self.poses(), return_inverse=True)[1])

    def with_walls(self, walls: FoundWalls, start: Start) -> "Problem":
        """Return the problem on the walls found, started where the recorded walls led."""
        return replace(self, dataset=walls.put_into(self.dataset), start=start, walls=walls)
