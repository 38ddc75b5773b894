"""The error terms of a sensor, added to true distances."""

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

from tofcorr.conditions import CONDITIONS
from tofcorr.correction.limits import Limits
from tofcorr.error_terms.domain import Domain
from tofcorr.error_terms.model import ErrorModel
from tofcorr.error_terms.model_options import ErrorModelOptions
from tofcorr.errors import ConfigError
from tofcorr.sensor.sensor_file import ErrorSection

# How often the measured distance is put into its own error. Each time the deviation is multiplied
# by the slope of the error, some 0.02: after 4 times 1e-7 of the error is left. Derived.
_ITERATIONS = 4


class Held(NamedTuple):
    """The variables of the error, held to their measured ranges; shapes (..., H, W)."""

    distance: Tensor
    amplitude: Tensor


class BaseError(nn.Module):
    r"""Error of the measured distance: constant and error terms.

    .. math:: D = D_\mathrm{true} + E(x, I, r, c, \text{conditions})

    where x is the true or the measured distance, as the sensor says. Distance and amplitude are
    held to the ranges that the sensor was measured in.

    Args:
        section: Terms and coefficients.
        domain: Image size and ranges.

    Attributes:
        model: The terms; their coefficients are the parameters.
    """

    ranges: Tensor
    mean_conditions: Tensor

    def __init__(self, section: ErrorSection, domain: Domain) -> None:
        super().__init__()
        self.reads_measured = section.reads == "measured_distance"
        self.model = error_model_of(section, domain)
        self.model_options = ErrorModelOptions(terms=section.terms)
        self.domain = domain
        limits = Limits.of_domain(domain, None, self.model)
        ranges = [limits.radial_distance, limits.amplitude, limits.normalised_amplitude]
        self.register_buffer("ranges", torch.tensor(ranges, dtype=torch.float64))
        means = [domain.conditions.get(name, (0.0, 0.0, 0.0))[2] for name in CONDITIONS]
        self.register_buffer("mean_conditions", torch.tensor(means, dtype=torch.float64))

    @property
    def needs_amplitude(self) -> bool:
        """Whether a term reads the amplitude."""
        return self.model.needs_amplitude()

    def forward(self, true: Tensor, amplitude: Tensor, conditions: Tensor | None) -> Tensor:
        """Return measured minus true distance, shape (..., H, W), metres.

        Args:
            true: True distances along the ray, shape (..., H, W), metres, all finite.
            amplitude: The camera's units, the same shape; any values if no term reads them.
            conditions: Shape (..., C) or (C,); None: the mean conditions.
        """
        fixed = self.model.pixel_error()
        if conditions is not None and len(self.model.condition_terms):
            fixed = fixed + self.model.condition_error(conditions)[..., None, None]
        error = self._signal_error(true, amplitude, fixed)
        if self.reads_measured:
            for _ in range(_ITERATIONS):
                error = self._signal_error(true + error, amplitude, fixed)
        return error.expand(true.shape)

    def _signal_error(self, distance: Tensor, amplitude: Tensor, fixed: Tensor) -> Tensor:
        error = fixed
        held = self.held(distance, amplitude)
        for term in self.model.signal_terms:
            strength = held.amplitude
            if term.uses_normalised_amplitude:
                square = held.distance.square()
                strength = (strength * square).clamp(self.ranges[2, 0], self.ranges[2, 1]) / square
            error = error + term(held.distance, strength)
        return error

    def held(self, distance: Tensor, amplitude: Tensor) -> Held:
        """Return distance and amplitude, held to their measured ranges."""
        return Held(
            distance.clamp(self.ranges[0, 0], self.ranges[0, 1]),
            amplitude.clamp(self.ranges[1, 0], self.ranges[1, 1]),
        )


def error_model_of(section: ErrorSection, domain: Domain) -> ErrorModel:
    """Build the error model of a file's section.

    Raises:
        ConfigError: A coefficient is missing.
    """
    model = ErrorModel(ErrorModelOptions(terms=section.terms), domain)
    groups = {
        group: {symbol: math.nan if value is None else value for symbol, value in named.items()}
        for group, named in section.coefficients.items()
    }
    try:
        model.set_paper_coefficients(groups)
    except KeyError as error:
        raise ConfigError(
            f"sensor: error.coefficients lack {error}, which a term of error.terms has."
        ) from None
    return model


def section_of(model: ErrorModel, section: ErrorSection) -> ErrorSection:
    """Return a section with the coefficients that a model has now."""
    groups = {
        group: {symbol: None if math.isnan(v) else v for symbol, v in named.items()}
        for group, named in model.paper_coefficients().items()
    }
    return section.model_copy(update={"coefficients": groups})
