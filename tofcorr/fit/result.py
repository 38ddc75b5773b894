"""What one fit found."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from tofcorr.correction.model import CalibrationModel
from tofcorr.error_terms.base import Domain
from tofcorr.error_terms.model import ErrorModelOptions
from tofcorr.estimation.moments import ImageMoments, Parameters, Prior
from tofcorr.estimation.noise import DistanceNoise
from tofcorr.estimation.solvers import Solution
from tofcorr.estimation.uncertainty import Covariance, Observability
from tofcorr.fit.noise_shift import NoiseShift
from tofcorr.fit.residual import ResidualOutcome
from tofcorr.fit.walls import FoundWalls, with_every_wall
from tofcorr.fit.weighting import PixelWeights
from tofcorr.pixels.dataset import Dataset


def _twist_mapping(twist: Tensor, rotation: Tensor) -> dict[str, list[float]]:
    """Return shift (mm) and turn (degrees) along the tool's axes.

    Args:
        twist: In camera axes, translation first, shape (6,), metres and radians.
        rotation: Of tool_from_camera, shape (3, 3).
    """
    return {
        "translation_mm": (1e3 * rotation @ twist[:3]).tolist(),
        "rotation_deg": torch.rad2deg(rotation @ twist[3:]).tolist(),
    }


class Assumption(NamedTuple):
    """What an error of something that the fit takes as given would do to the hand-eye transform.

    Attributes:
        name: Of the error, for programs, such as `focal_length`.
        error: In words, such as "focal length 0.1 % longer": of what the recording should say.
        twist: How far the transform would move, in camera axes, translation first, shape (6,),
            metres and radians.
    """

    name: str
    error: str
    twist: Tensor

    def to_mapping(self, rotation: Tensor) -> dict[str, Any]:
        """Return plain values for JSON, along the tool's axes.

        Args:
            rotation: Of tool_from_camera, shape (3, 3).
        """
        return {
            "name": self.name,
            "error": self.error,
            **_twist_mapping(self.twist, rotation),
        }


class Misfit(NamedTuple):
    """An error that the model lacks.

    Attributes:
        probe: Name of the pattern that shows it.
        trace: What the residuals do: it follows "the residuals".
        p_value: Probability of such residuals by chance, with all probes that were tried.
        twist: How far the hand-eye transform would move with a term for it, in camera axes,
            translation first, shape (6,), metres and radians.
    """

    probe: str
    trace: str
    p_value: float
    twist: Tensor

    @property
    def shift(self) -> float:
        """How far the camera would move, metres."""
        return float(self.twist[:3].norm())

    @property
    def turn(self) -> float:
        """How far it would turn, radians."""
        return float(self.twist[3:].norm())

    def in_words(self) -> str:
        """Return one sentence for the user."""
        return (
            f"The residuals {self.trace}: the model lacks a term. With one, the hand-eye transform "
            f"would lie {1e3 * self.shift:.1f} mm and {1e3 * self.turn:.1f} mrad from this one. "
            "Its standard errors are widened by that; `tofcorr diagnose` looks for the cause."
        )

    def to_mapping(self, rotation: Tensor) -> dict[str, Any]:
        """Return plain values for JSON, along the tool's axes.

        Args:
            rotation: Of tool_from_camera, shape (3, 3).
        """
        return {
            "probe": self.probe,
            "residuals": self.trace,
            "p_value": self.p_value,
            **_twist_mapping(self.twist, rotation),
        }


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
