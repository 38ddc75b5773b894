"""The columns of the base model: hand-eye transform, estimated walls, constant, error terms."""

from copy import copy

import torch
from torch import Tensor

from tofcorr.diagnosis.sums.estimated_planes import (
    PER_WALL,
    wall_columns,
    with_planes,
    with_walls_moved,
)
from tofcorr.diagnosis.sums.observations import Observations
from tofcorr.diagnosis.sums.prediction import hand_eye_columns, predicted_distance
from tofcorr.error_terms.base import ConditionTerm, PixelTerm, SignalTerm, Term
from tofcorr.error_terms.domain import Domain
from tofcorr.error_terms.model import ErrorModel
from tofcorr.error_terms.model_options import ErrorModelOptions
from tofcorr.pixels.domain import domain_from

# Prior standard deviations of the hand-eye transform, metres and radians, and of the coefficients
# of error terms, metres. Chosen so wide that they matter only in directions without data.
_HAND_EYE_SD = (0.3, 0.3, 0.3, 0.5, 0.5, 0.5)
_ERROR_SD = 1.0
# The same of an estimated wall: two turns, radians, and a shift, metres.
_WALL_SD = (0.5, 0.5, 0.3)
# Share of the values below and above the range of a variable, so that single gross errors do not
# stretch it. Chosen; training takes 0.001.
_OUTSIDE_SHARE = 0.0005


class BaseModel:
    """Hand-eye transform, estimated walls and error model, linear around a start.

    The walls are where the observations have them. Measured planes are no part of the model.

    Args:
        observations: The recording; its ranges scale the variables of the error terms.
        options: Terms of the error model; a fixed pattern among them has no columns here.
        hand_eye_free: Whether the hand-eye transform is estimated.

    Attributes:
        domain: The ranges of the recording's variables.

    Raises:
        CalibrationDataError: The recording lacks what a term needs.
    """

    def __init__(
        self, observations: Observations, options: ErrorModelOptions, *, hand_eye_free: bool
    ) -> None:
        self.hand_eye_free = hand_eye_free
        self.options = options
        self.domain = domain_of(observations)
        self.error_model = ErrorModel(options, self.domain)
        self._look_at(observations)

    def on(self, observations: Observations) -> "BaseModel":
        """Return the same model, scaled alike, on other pixels."""
        other = copy(self)
        other._look_at(observations)
        return other

    def _look_at(self, observations: Observations) -> None:
        self.observations = observations
        width = observations.recording.camera.width
        rows = torch.div(observations.pixel, width, rounding_mode="floor").double()
        columns = torch.remainder(observations.pixel, width).double()
        parts = [term.basis(rows, columns) for term in self.pixel_terms]
        if self.condition_terms:
            conditions = observations.conditions()
            of_frames = torch.cat([term.basis(conditions) for term in self.condition_terms])
            parts.append(of_frames[:, observations.frame])
        self._by_place = [part.detach() for part in parts]

    @property
    def signal_terms(self) -> list[SignalTerm]:
        """Terms of distance and amplitude, in the order of their columns."""
        return [t for t in self.error_model.signal_terms if isinstance(t, SignalTerm)]

    @property
    def pixel_terms(self) -> list[PixelTerm]:
        """Terms of the position in the image, in the order of their columns."""
        return [t for t in self.error_model.pixel_terms if isinstance(t, PixelTerm)]

    @property
    def condition_terms(self) -> list[ConditionTerm]:
        """Terms of the conditions of a frame, in the order of their columns."""
        return [t for t in self.error_model.condition_terms if isinstance(t, ConditionTerm)]

    @property
    def terms(self) -> list[Term]:
        """All terms with columns, in their order."""
        return [*self.signal_terms, *self.pixel_terms, *self.condition_terms]

    @property
    def groups(self) -> set[str]:
        """Groups of the terms, as in `Term.group`."""
        return {term.group for term in self.terms}

    @property
    def num_hand_eye(self) -> int:
        """Number of columns of the hand-eye transform."""
        return 6 if self.hand_eye_free else 0

    @property
    def num_geometry(self) -> int:
        """Number of columns of hand-eye transform and estimated walls; they come first."""
        return self.num_hand_eye + PER_WALL * self.observations.num_walls

    @property
    def num_columns(self) -> int:
        """Number of columns."""
        return self.num_geometry + len(self.error_model.symbols())

    def moved(self, step: Tensor) -> "BaseModel":
        """Return the model after a step of the geometry columns, with its walls moved."""
        if self.num_geometry == self.num_hand_eye:
            return self
        other = copy(self)
        walls = step[self.num_hand_eye : self.num_geometry]
        other.observations = with_walls_moved(self.observations, walls)
        return other

    def with_walls_of(self, other: "BaseModel") -> "BaseModel":
        """Return the model with its estimated walls where another has them."""
        if self.num_geometry == self.num_hand_eye:
            return self
        model, facts = copy(self), other.observations.facts
        model.observations = with_planes(self.observations, facts.normal_world, facts.offset)
        return model

    def prior_precision(self) -> Tensor:
        """Return the precision of the coefficients' priors, diagonal, shape (K, K)."""
        hand_eye = _HAND_EYE_SD[: self.num_hand_eye]
        walls = _WALL_SD * self.observations.num_walls
        sd = [*hand_eye, *walls, *[_ERROR_SD] * (self.num_columns - self.num_geometry)]
        return torch.diag(torch.tensor(sd, dtype=torch.float64) ** -2)

    def roughness(self) -> Tensor:
        r"""Return the penalty matrix of curves, :math:`\sum \lambda F^T F`, shape (K, K).

        As in training, its unit is one over the sum of the weights of the residuals.
        """
        matrix = torch.zeros(self.num_columns, self.num_columns, dtype=torch.float64)
        for term, first in self.error_model.penalised():
            rows = term.roughness()
            start = self.num_geometry + first
            inside = slice(start, start + rows.shape[1])
            matrix[inside, inside] += float(term.strength) * rows.T @ rows
        return matrix

    def error_columns(self, distance: Tensor) -> Tensor:
        """Return constant and terms at predicted distances (M,), metres, shape (M, K)."""
        amplitude = self.observations.amplitude
        amplitude = torch.zeros_like(distance) if amplitude is None else amplitude
        by_signal = [term.basis(distance, amplitude).detach() for term in self.signal_terms]
        # Rows (K, M) are filled several times faster than columns.
        return torch.cat([torch.ones_like(distance)[None], *by_signal, *self._by_place]).T

    def columns(self, tool_from_camera: Tensor) -> Tensor:
        """Return all columns around a hand-eye transform (4, 4), shape (M, K)."""
        return self.linearised(tool_from_camera)[1]

    def linearised(self, tool_from_camera: Tensor) -> tuple[Tensor, Tensor]:
        """Return the predicted distance, (M,), metres, and all columns, (M, K)."""
        parts = []
        if self.hand_eye_free:
            distance, columns = hand_eye_columns(self.observations, tool_from_camera)
            parts.append(columns)
        else:
            distance = predicted_distance(self.observations, tool_from_camera)
        if self.observations.num_walls:
            parts.append(wall_columns(self.observations, tool_from_camera))
        parts.append(self.error_columns(distance))
        return distance, torch.cat([part.T for part in parts]).T


def domain_of(observations: Observations) -> Domain:
    """Return the ranges of the recording's variables."""
    recording = observations.recording
    return domain_from(
        recording.camera,
        observations.measured,
        observations.amplitude,
        recording.modulation_frequency,
        observations.conditions(),
        outside_share=_OUTSIDE_SHARE,
        method="nearest",
    )
