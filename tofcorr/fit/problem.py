"""One fitting problem and its solution: the options, what a fit looks at, and what it found."""

from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from pydantic import Field, NonNegativeFloat, PositiveInt
from torch import Tensor

from tofcorr.correction.model import CalibrationModel
from tofcorr.error_terms.base import Domain
from tofcorr.error_terms.model import ErrorModel, ErrorModelOptions
from tofcorr.error_terms.residual import ResidualNetworkOptions
from tofcorr.errors import CalibrationDataError
from tofcorr.estimation.accumulator import Design
from tofcorr.estimation.moments import (
    HAND_EYE_SYMBOLS,
    ImageMoments,
    MomentObjective,
    Parameters,
    Prior,
)
from tofcorr.estimation.noise import DistanceNoise
from tofcorr.estimation.planes import Walls
from tofcorr.estimation.robust import RobustLoss
from tofcorr.estimation.solvers import (
    Solution,
    SolverOptions,
    Watcher,
    initial_parameters,
    with_linear_part,
)
from tofcorr.estimation.uncertainty import (
    Covariance,
    Direction,
    Observability,
    posterior_covariance,
    worst_axes,
)
from tofcorr.fit.known import PriorKnowledge
from tofcorr.fit.walls import FoundWalls
from tofcorr.fit.weighting import PixelWeights
from tofcorr.options import Options
from tofcorr.pixels.dataset import (
    Dataset,
    HandEyeOptions,
    PlaneChoice,
    hand_eye_is_free,
    recorded_hand_eye,
    resolved_planes,
)
from tofcorr.pixels.lattice import Lattice


class WeightOptions(Options):
    """The weight of each pixel.

    Attributes:
        noise: Whether a pixel's weight is one over its noise variance, estimated from frames of
            one pose, or else from neighbouring pixels.
        robust: The robust loss: `huber` bounds the influence of an outlier, with `cauchy` that of
            a gross one vanishes.
        passes: Most passes of reweighting.
    """

    noise: bool = False
    robust: RobustLoss = "none"
    passes: PositiveInt = 20


class ResidualOptions(Options):
    """How the residual network is fitted, and when it is kept.

    Attributes:
        network: Its size and bound.
        pixels: How many pixels it is fitted to, of all frames together.
        iterations: Most Gauss-Newton steps of the fit together with hand-eye and coefficients.
        weight_decay: Weight of the network's energy in a loss that is the mean squared residual.
            The default is between what is best for views between others (1.5e-4) and for runs of
            views unlike all others (5e-4), on views of a Kinect v2.
        joint: Whether an estimated hand-eye transform is fitted once more together with the
            network, and the coefficients with it. Without this, errors that the core cannot
            describe bias it.
        folds: Folds of the cross-validation that decides: runs of successive poses.
        keep: `if_better` drops a network that does not help on held-out images; `always` keeps it.
    """

    network: ResidualNetworkOptions = ResidualNetworkOptions()
    pixels: PositiveInt = 25_000
    iterations: PositiveInt = 200
    weight_decay: NonNegativeFloat = 2.5e-4
    joint: bool = True
    folds: int = Field(default=5, ge=2)
    keep: Literal["if_better", "always"] = "if_better"


class FitOptions(Options):
    """How one model is fitted to given frames.

    Attributes:
        model: The terms of the error.
        residual: A small network on what the terms leave, kept if it improves held-out images;
            null: none.
        hand_eye: Whether the hand-eye transform is estimated, and where its estimate starts.
        solver: The optimiser.
        weights: The weight of each pixel.
        planes: `known`: the recorded planes are right, within their covariance if frames.csv has
            one; `unknown`: every wall (frames of
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
    amplitude = domain.amplitude
    for term in options.terms:
        # Where the amplitude never changes, no coefficient of such a term is determined.
        if "amplitude" in term.needs and amplitude is not None and amplitude.low >= amplitude.high:
            one = f"amplitude.npy holds {amplitude.low:g} in every pixel used, not measured ones"
            said = f"{one}. Remove it, and choose models without {term.kind}: {_DEPTH_ALONE}."
            raise CalibrationDataError(f"{dataset.first.path}: {said}")
    error = ErrorModel(options, domain)
    return error, Design(error, domain, dataset.ray_directions())


_DEPTH_ALONE = "`--config e0` (evaluate, select: `--set 'models=[{config: e0}]'`) needs depth alone"


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
                advice = f"Record it, or choose models without that term: {_DEPTH_ALONE}."
                raise CalibrationDataError(f"{error} {advice}") from None


@dataclass(frozen=True)
class Problem:
    """Everything that the steps of a fit look at, apart from the moments.

    Attributes:
        dataset: The recordings, with the walls found once they are found.
        frames: Global numbers of the frames to fit, shape (N,).
        options: Model, hand-eye, solver and device.
        domain: The ranges that scale the model's variables.
        lattice: Evenly spread pixels of the frames; None: nothing asks for the noise.
        watcher: Called after each iteration of the solver.
        resumed: Where an earlier fit stood; None starts anew.
        walls: The estimated walls; None as long as the recorded ones are used.
        known: What earlier calibrations say; None: nothing.
    """

    dataset: Dataset
    frames: np.ndarray
    options: FitOptions
    domain: Domain
    lattice: Lattice | None = None
    watcher: Watcher | None = None
    resumed: Parameters | None = None
    walls: FoundWalls | None = None
    known: PriorKnowledge | None = None

    def poses(self) -> Tensor:
        """Return the pose of each frame, shape (N,), numbered from zero without gaps."""
        groups = self.dataset.pose_groups()[self.frames]
        return torch.from_numpy(np.unique(groups, return_inverse=True)[1])

    @property
    def estimates_walls(self) -> bool:
        """Whether the recorded planes are a mere start."""
        return resolved_planes(self.options.planes, self.dataset.recordings) == "unknown"

    @property
    def estimated(self) -> Walls | None:
        """The estimated walls alone."""
        return None if self.walls is None else self.walls.walls

    def on(self, walls: FoundWalls, resumed: Parameters | None) -> "Problem":
        """Return the problem on walls that were found, started at some parameters."""
        data = walls.put_into(self.dataset)
        return replace(self, dataset=data, walls=walls, resumed=resumed)

    def guess(self, moments: ImageMoments) -> Parameters:
        """Return the recorded hand-eye transform and no error: the centre of the prior."""
        zero = torch.zeros(len(moments.symbols), dtype=torch.float64)
        if self.known is not None and self.known.parameters.hand_eye_is_free:
            return replace(self.known.parameters, coefficients=zero)
        free = hand_eye_is_free(self.dataset, self.options.hand_eye)
        return Parameters(recorded_hand_eye(self.dataset), zero, free)

    def start(self, moments: ImageMoments) -> Parameters:
        """Return where the solver starts on these moments, whichever columns they hold.

        The resumed parameters, if there are any with as many coefficients as the moments have
        columns; otherwise the better of the recorded transform and a closed form.
        """
        resumed = self.resumed
        if resumed is not None and resumed.coefficients.numel() == len(moments.symbols):
            return resumed
        guess = self.guess(moments)
        candidates = [with_linear_part(moments, guess)]
        if guess.hand_eye_is_free and self.options.hand_eye.start == "auto":
            candidates.append(initial_parameters(moments, guess.tool_from_camera))
        objective = MomentObjective(moments)
        return min(candidates, key=lambda candidate: float(objective.loss(candidate)))


class Shift(NamedTuple):
    """How far something moves the hand-eye transform that the fit does not estimate.

    It is the noise of the distances, an error that the model lacks, or an error of what the fit
    takes as given.

    Attributes:
        cause: What moves it, for programs, such as `focal_length`.
        words: What it is: of an error of the recording "focal length 0.1 % longer"; of one that
            the model lacks, what the residuals do.
        twist: How far the transform moves, in camera axes, translation first, shape (6,), metres
            and radians.
        p_value: Probability of such residuals by chance, with all patterns that were tried.
        removed: Whether the estimate was moved back.
    """

    cause: str
    words: str
    twist: Tensor
    p_value: float | None = None
    removed: bool = False

    @property
    def size(self) -> tuple[float, float]:
        """How far the camera moves, metres, and turns, radians."""
        return float(self.twist[:3].norm()), float(self.twist[3:].norm())

    @property
    def left(self) -> Tensor:
        """Standard error that it leaves in the hand-eye transform, as a twist (6,)."""
        # Of what noise moves, a fifth. Measured: in 12 designs of the simulator and of
        # `benchmarks/hand_eye_bias.py` the error along the view is 0.7 to 1.2 times the shift.
        return self.twist / 5 if self.removed else self.twist

    def lacking(self) -> str:
        """Return one sentence for the user about an error that the model lacks."""
        moved, turned = self.size
        lacking = f"The residuals {self.words}: the model lacks a term, which moves the hand-eye by"
        lacking = f"{lacking} {1e3 * moved:.1f} mm and {1e3 * turned:.1f} mrad"
        return f"{lacking}. `tofcorr diagnose` looks for it."

    def to_mapping(self, rotation: Tensor) -> dict[str, Any]:
        """Return shift (mm) and turn (degrees) along the tool's axes, for JSON.

        Args:
            rotation: Of tool_from_camera, shape (3, 3).
        """
        return {
            "translation_mm": (1e3 * rotation @ self.twist[:3]).tolist(),
            "rotation_deg": torch.rad2deg(rotation @ self.twist[3:]).tolist(),
        }


@dataclass(frozen=True, kw_only=True)
class Core:
    """The parametric part of a fit: hand-eye and coefficients, without residual network.

    Attributes:
        options: The terms, with the values found in the data in place of `auto`.
        moments: The moments of the images fitted, with the columns of the condition terms.
        start: Where the solver started.
        solution: The parameters found, and why the solver stopped.
        smoothness: The smoothing penalties as a prior; None if no term is penalised, or if earlier
            calibrations are carried in, which hold it already.
        carried: What earlier calibrations say, as a prior; None: there is none.
        observability: How well the images determine each direction, without the prior; None as
            long as nobody asked.
        prior: On the directions that they do not determine; None if there is none.
    """

    options: ErrorModelOptions
    moments: ImageMoments
    start: Parameters
    solution: Solution
    smoothness: Prior | None
    carried: Prior | None = None
    observability: Observability | None = None
    prior: Prior | None = None

    @property
    def total_prior(self) -> Prior | None:
        """Every prior of the fit: on undetermined directions, and what was known before."""
        before = self.carried or self.smoothness
        if self.prior is None or before is None:
            return self.prior or before
        return self.prior.joined(before)


@dataclass(frozen=True, kw_only=True)
class Fit(Core):
    """One fitted model.

    The loss of its `solution` is that of `optimum`.

    Attributes:
        observability: How well the images determine each direction, without the prior.
        model: The error model and hand-eye, with the fitted parameters.
        domain: The ranges it was calibrated on.
        optimum: The parameters of the least loss; the estimate is where the least loss were
            without the noise of the distances, unless `noise_shift` says otherwise.
        hand_eye_only: The best hand-eye transform without any depth correction.
        covariance: Uncertainty of the parameters, by leaving out one pose at a time.
        residual: How the residual network was decided on, one sentence; None if none was asked for.
        weights: The weight of each pixel; None if all have the same.
        walls: The estimated walls; None if the recorded ones were used.
        noise: Of a measured distance; None if unknown.
        noise_shift: How far that noise moves the hand-eye transform, and whether the estimate was
            moved back; None if the noise is unknown or the transform is not estimated.
        misfit: An error that the model lacks and that would move the hand-eye transform out of its
            interval; None if there is none, or none was looked for.
        assumptions: What errors of the intrinsics and of measured planes would do to the hand-eye
            transform; empty if that was not asked for.
    """

    observability: Observability  # pyright: ignore[reportGeneralTypeIssues] - known by then
    model: CalibrationModel
    domain: Domain
    optimum: Parameters
    hand_eye_only: Parameters
    covariance: Covariance
    residual: str | None = None
    weights: PixelWeights | None = None
    walls: FoundWalls | None = None
    noise: DistanceNoise | None = None
    noise_shift: Shift | None = None
    misfit: Shift | None = None
    assumptions: tuple[Shift, ...] = ()

    def is_unseen(self, one: Direction) -> bool:
        """Return whether a sensor of one ray shows a direction from no pose.

        A turn about the ray changes no distance, and a shift along it is a constant error.
        """
        along = {"t_z", "w_z", "c0"} if self.domain.height * self.domain.width == 1 else set()
        return one.is_undetermined and set(one.shares) <= along

    @property
    def gain(self) -> float:
        """How much the corrected depth of the fitted pixels changes with the measured one.

        The slope of a line through both, along the optical axis, at the least loss; 1 where the
        correction is a constant, and near 0 where it takes every point to the camera. NaN where all
        pixels measured one depth.
        """
        coefficients = self.optimum.coefficients
        corrected = torch.cat([coefficients.new_ones(1), -coefficients])
        gram = self.moments.gram.sum(dim=0)
        mean, total = gram[2:-1:3, -1], gram[-1, -1]
        with_measured = gram[2, 2:-1:3] - mean[0] * mean / total
        return float(with_measured @ corrected / with_measured[0])

    @property
    def directions(self) -> list[Direction]:
        """Every direction of `observability` with its standard error, the weakest first.

        By `hand_eye_covariance`, as in every table and export: what speaks of errors asks here.
        """
        matrix, vectors = self.covariance.matrix.clone(), self.observability.vectors
        if self.solution.parameters.hand_eye_is_free:
            matrix[:6, :6] = self.hand_eye_covariance
        errors = (vectors * (matrix @ vectors)).sum(dim=0).clamp(min=0).sqrt().tolist()
        both = zip(self.observability.directions, errors, strict=True)
        return sorted((one._replace(sigma=k) for one, k in both), key=lambda one: -one.sigma)

    @property
    def hand_eye_covariance(self) -> Tensor:
        """Mean square error of the hand-eye transform, shape (6, 6).

        The scatter between poses, what is left of the noise's shift, and the shift by an error
        that the model lacks.
        """
        matrix = self.covariance.matrix[:6, :6]
        if not self.solution.parameters.hand_eye_is_free:
            return torch.zeros(6, 6).to(matrix)
        for one in (self.noise_shift, self.misfit):
            matrix = matrix if one is None else matrix + torch.outer(one.left, one.left)
        return matrix

    @property
    def joint_covariance(self) -> Tensor:
        """Covariance of a step of all unknowns, shape (P, P), for a later fit to start from.

        The scatter between poses and the curvature, weighed by the number of poses and of unknowns:
        of few poses the scatter alone says of some direction that it is known exactly.
        """
        matrix = self.covariance.matrix.clone()
        if self.solution.parameters.hand_eye_is_free:
            matrix[:6, :6] = self.hand_eye_covariance
        poses, unknowns = len(self.covariance.jackknife), len(matrix)
        curved = posterior_covariance(self.observability.precision)
        return (poses * matrix + unknowns * curved) / (poses + unknowns)

    @property
    def residual_variance(self) -> float:
        """The effective variance of a residual, by these images and by what was carried in."""
        return self.observability.variance if self.carried is None else self.carried.variance

    @property
    def hand_eye_errors(self) -> tuple[float, float]:
        """Largest standard errors of shift and turn that poses can show, metres and radians."""
        hidden = [one.shares for one in self.observability.directions if self.is_unseen(one)]
        seen = [float(all(name not in one for one in hidden)) for name in HAND_EYE_SYMBOLS]
        shown = torch.tensor(seen, dtype=torch.float64)
        return worst_axes(self.hand_eye_covariance * shown[:, None] * shown)
