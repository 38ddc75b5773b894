"""The error terms of a sensor, added to true distances."""

import math
from dataclasses import replace

import torch
from torch import Tensor, nn

from tofcorr.correction.limits import Limits
from tofcorr.error_terms.base import SignalTerm
from tofcorr.error_terms.domain import Domain, Interval
from tofcorr.error_terms.model import ErrorModel, ErrorModelOptions
from tofcorr.errors import ConfigError
from tofcorr.sensor.sensor_file import ErrorSection

# How often the measured distance is put into its own error. Each time the deviation is multiplied
# by the slope of the error, 0.05 at most: after 3 times 6e-6 of the error is left. Derived.
_ITERATIONS = 3


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

    mean_conditions: Tensor

    def __init__(self, section: ErrorSection, domain: Domain) -> None:
        super().__init__()
        self.reads_measured = section.reads == "measured_distance"
        self.model = error_model_of(section, domain)
        self.model_options = ErrorModelOptions(terms=section.terms)
        self._at_amplitude = [not _reads_distance(term) for term in self._terms()]
        self.domain = domain
        self.limits = Limits.of_domain(domain, None, self.model)
        if not self.reads_measured:
            self.limits = replace(self.limits, radial_distance=self._true_range(domain))
        means = torch.tensor(domain.mean_conditions(), dtype=torch.float64)
        self.register_buffer("mean_conditions", means)

    @property
    def needs_amplitude(self) -> bool:
        """Whether a term reads the amplitude."""
        return self.model.needs_amplitude()

    @torch.no_grad()
    def _true_range(self, domain: Domain) -> Interval:
        """Return the true distances whose measured ones fill the range, in any pixel and light."""
        lights = self.limits.amplitude if self.needs_amplitude else Interval(1.0, 1.0)
        ends = []
        for distance in domain.radial_distance:
            like = self.model.constant.new_full((domain.height, domain.width), distance)
            ends.append([self.model(like, torch.full_like(like, light)) for light in lights])
        (near, far), (low, high) = (torch.stack(end) for end in ends), domain.radial_distance
        return Interval(low - float(near.max()), high - float(far.min()))

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
        held = amplitude.clamp(*self.limits.amplitude) if self.needs_amplitude else amplitude
        fixed = fixed + self._error_at_amplitude(true, held)
        error = self._signal_error(true, held, fixed)
        if self.reads_measured:
            for _ in range(_ITERATIONS):
                error = self._signal_error(true + error, held, fixed)
        return error.expand(true.shape)

    def _terms(self) -> list[SignalTerm]:
        return [term for term in self.model.signal_terms if isinstance(term, SignalTerm)]

    def _error_at_amplitude(self, distance: Tensor, amplitude: Tensor) -> Tensor | float:
        """Return the error of the terms that do not read the distance, however it is iterated."""
        chosen = zip(self._terms(), self._at_amplitude, strict=True)
        return sum((term(distance, amplitude) for term, at in chosen if at), 0.0)

    def _signal_error(self, distance: Tensor, amplitude: Tensor, fixed: Tensor) -> Tensor:
        """Return `fixed` and the error of the terms that read the distance."""
        error = fixed
        distance = distance.clamp(*self.limits.radial_distance)
        for term, at_amplitude in zip(self._terms(), self._at_amplitude, strict=True):
            if at_amplitude:
                continue
            strength = amplitude
            if term.uses_normalised_amplitude:
                square = distance.square()
                strength = (strength * square).clamp(*self.limits.normalised_amplitude) / square
            error = error + term(distance, strength)
        return error

    def covers(self, distance: Tensor, amplitude: Tensor | None) -> Tensor:
        """Return where distance, and amplitude if given, are within their measured ranges, bool."""
        near, far = self.limits.radial_distance
        inside = (distance >= near) & (distance <= far)
        if amplitude is None:
            return inside
        dark, bright = self.limits.amplitude
        return inside & (amplitude >= dark) & (amplitude <= bright)


def _reads_distance(term: SignalTerm) -> bool:
    polynomial, axes = term.polynomial(), term.axes()
    if polynomial is not None:
        return polynomial.variable != "amplitude"
    return axes is None or any(axis.variable == "distance" for axis in axes)


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
