"""What one fit found."""

from dataclasses import dataclass

import torch
from torch import Tensor

from tofcorr.correction.model import CalibrationModel
from tofcorr.error_terms.domain import Domain
from tofcorr.error_terms.model import ErrorModelOptions
from tofcorr.estimation.moments import ImageMoments
from tofcorr.estimation.noise import DistanceNoise
from tofcorr.estimation.objective import Parameters, Prior
from tofcorr.estimation.solvers import Solution
from tofcorr.estimation.uncertainty import Covariance, Observability
from tofcorr.fit.misfit.assumption import Assumption
from tofcorr.fit.misfit.found import Misfit
from tofcorr.fit.noise_shift import NoiseShift
from tofcorr.fit.residual import ResidualOutcome
from tofcorr.fit.walls import FoundWalls, with_every_wall
from tofcorr.fit.weighting import PixelWeights
from tofcorr.pixels.dataset import Dataset


@dataclass(frozen=True)
class Fit:
    """One fitted model.

    Attributes:
        model: The error model and hand-eye, with the fitted parameters.
        domain: The ranges it was calibrated on.
        solution: The estimate, and why the solver stopped. Its loss is that of `optimum`.
        optimum: The parameters of the least loss; the estimate is where the least loss were
            without the noise of the distances, unless `noise_shift` says otherwise.
        hand_eye_only: The best hand-eye transform without any depth correction.
        covariance: Uncertainty of the parameters, by leaving out one pose at a time.
        moments: The moments of the frames fitted.
        observability: How well the images determine each direction, without the prior.
        prior: The prior on the directions that they do not determine; None if there is none.
        total_prior: Every prior of the fit: that one, and the smoothness of penalised curves.
        poses: The pose of each image fitted, shape (N,), counted from zero.
        options: The model's terms, with the values found in the data in place of `auto`.
        residual: How the residual network was decided on; None if none was asked for.
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

    model: CalibrationModel
    domain: Domain
    solution: Solution
    optimum: Parameters
    hand_eye_only: Parameters
    covariance: Covariance
    moments: ImageMoments
    observability: Observability
    prior: Prior | None
    total_prior: Prior | None
    poses: Tensor
    options: ErrorModelOptions
    residual: ResidualOutcome | None = None
    weights: PixelWeights | None = None
    walls: FoundWalls | None = None
    noise: DistanceNoise | None = None
    noise_shift: NoiseShift | None = None
    misfit: Misfit | None = None
    assumptions: tuple[Assumption, ...] = ()

    def on_its_walls(self, dataset: Dataset) -> Dataset:
        """Return the data set with the walls that the fit estimated, if it did.

        Walls of no training image are estimated alone, under the fitted model, where the recorded
        planes are estimates themselves.
        """
        return dataset if self.walls is None else with_every_wall(dataset, self.walls, self.model)

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
    def hand_eye_covariance(self) -> Tensor:
        """Mean square error of the hand-eye transform, shape (6, 6).

        The scatter between poses, what is left of the noise's shift, and the shift by an error
        that the model lacks.
        """
        matrix = self.covariance.matrix[:6, :6]
        if self.noise_shift is not None:
            matrix = matrix + torch.outer(self.noise_shift.left, self.noise_shift.left)
        if self.misfit is not None:
            matrix = matrix + torch.outer(self.misfit.twist, self.misfit.twist)
        return matrix
