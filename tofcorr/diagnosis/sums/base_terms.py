"""The columns of the base model: hand-eye, constant, and the terms of the error model."""

from copy import copy

import torch
from torch import Tensor

from tofcorr.diagnosis.sums.observations import Observations
from tofcorr.diagnosis.sums.prediction import hand_eye_columns, predicted_distance
from tofcorr.error_terms.base import PixelTerm, SignalTerm
from tofcorr.error_terms.domain import Domain, Interval
from tofcorr.error_terms.model import ErrorModel, ErrorModelOptions

# Priors so wide that they matter only where the poses say nothing, metres or radians.
_HAND_EYE_SD = (0.3, 0.3, 0.3, 0.5, 0.5, 0.5)
_ERROR_SD = 1.0


class BaseModel:
    """Hand-eye transform and error model, linear around a hand-eye transform.

    Args:
        observations: The recording; its ranges scale the error model's variables.
        options: Terms of the error model.
        hand_eye_free: Whether the hand-eye transform is estimated.
    """

    def __init__(
        self, observations: Observations, options: ErrorModelOptions, *, hand_eye_free: bool
    ) -> None:
        self.hand_eye_free = hand_eye_free
        self.error_model = ErrorModel(options, domain_of(observations))
        self._look_at(observations)

    def on(self, observations: Observations) -> "BaseModel":
        """Return the same model, scaled alike, on other pixels."""
        other = copy(self)
        other._look_at(observations)
        return other

    def _look_at(self, observations: Observations) -> None:
        self.observations = observations
        rows = torch.div(
            observations.pixel, observations.recording.camera.width, rounding_mode="floor"
        ).double()
        columns = torch.remainder(observations.pixel, observations.recording.camera.width).double()
        parts = [term.basis(rows, columns) for term in self.pixel_terms]
        self._by_pixel = torch.cat([part.detach().T for part in parts], dim=1) if parts else None

    @property
    def signal_terms(self) -> list[SignalTerm]:
        """Terms of distance and amplitude, in the order of their columns."""
        return [t for t in self.error_model.signal_terms if isinstance(t, SignalTerm)]

    @property
    def pixel_terms(self) -> list[PixelTerm]:
        """Terms of the place in the image, in the order of their columns."""
        return [t for t in self.error_model.pixel_terms if isinstance(t, PixelTerm)]

    @property
    def num_hand_eye(self) -> int:
        """Number of columns of the hand-eye transform."""
        return 6 if self.hand_eye_free else 0

    @property
    def num_columns(self) -> int:
        """Number of columns."""
        return self.num_hand_eye + len(self.error_model.symbols())

    def prior_precision(self) -> Tensor:
        """Return the inverse variances of the columns' priors, shape (K,)."""
        hand_eye = _HAND_EYE_SD[: self.num_hand_eye]
        sd = [*hand_eye, *[_ERROR_SD] * (self.num_columns - self.num_hand_eye)]
        return torch.tensor(sd, dtype=torch.float64) ** -2

    def error_columns(self, distance: Tensor) -> Tensor:
        """Return constant and terms at predicted distances (M,), shape (M, K)."""
        amplitude = self.observations.amplitude
        amplitude = torch.zeros_like(distance) if amplitude is None else amplitude
        parts = [torch.ones_like(distance)[:, None]]
        parts += [term.basis(distance, amplitude).detach().T for term in self.signal_terms]
        if self._by_pixel is not None:
            parts.append(self._by_pixel)
        return torch.cat(parts, dim=1)

    def columns(self, tool_from_camera: Tensor) -> Tensor:
        """Return all columns around a hand-eye transform, shape (M, K)."""
        error = self.error_columns(predicted_distance(self.observations, tool_from_camera))
        if not self.hand_eye_free:
            return error
        return torch.cat([hand_eye_columns(self.observations, tool_from_camera), error], dim=1)


def domain_of(observations: Observations) -> Domain:
    """Return the ranges of the recording's variables."""
    camera = observations.recording.camera
    distance, amplitude = observations.measured, observations.amplitude
    normalised = None if amplitude is None else amplitude * distance**2
    return Domain(
        height=camera.height,
        width=camera.width,
        radial_distance=_range(distance),
        amplitude=None if amplitude is None else _range(amplitude),
        normalised_amplitude=None if normalised is None else _range(normalised),
    )


def _range(values: Tensor) -> Interval:
    ordered = values.sort().values
    last = len(ordered) - 1
    low, high = ordered[round(0.0005 * last)], ordered[round(0.9995 * last)]
    return Interval(float(low), float(high))
