"""The error model at runtime: float32, what never changes precomputed, few passes over memory."""

import copy

import torch
from torch import Tensor, nn

from tofcorr.correction.limits import Limits, is_normalised
from tofcorr.correction.runtime_polynomial import RuntimePolynomial
from tofcorr.error_terms.amplitude import AmplitudePolynomial
from tofcorr.error_terms.distance import DistancePolynomial
from tofcorr.error_terms.domain import Interval
from tofcorr.error_terms.model import ErrorModel


class RuntimeErrorModel(nn.Module):
    """The predicted error times a factor, taken apart for the corrector.

    Constant and pixel terms become one image. Polynomials in the distance, in the amplitude and
    in the distance-normalised amplitude run in place; every other term runs as it is, in float32.

    Args:
        model: The float64 model.
        limits: Ranges of the variables.
        factor: What to multiply by; a power of two, so that it costs no accuracy.

    Attributes:
        offset: Constant and pixel terms, times the factor, shape (H, W), float32.
    """

    offset: Tensor

    def __init__(self, model: ErrorModel, limits: Limits, factor: float) -> None:
        super().__init__()
        by_distance = [t for t in model.signal_terms if isinstance(t, DistancePolynomial)]
        polynomials = [t for t in model.signal_terms if isinstance(t, AmplitudePolynomial)]
        by_amplitude = [t for t in polynomials if t.variable == "amplitude"]
        by_normalised = [t for t in polynomials if is_normalised(t)]
        folded = [*by_distance, *by_amplitude, *by_normalised]
        others = [t for t in model.signal_terms if all(t is not f for f in folded)]

        self.factor: float = factor
        self.distance = _sum(by_distance, limits.radial_distance, factor)
        self.amplitude = _sum(by_amplitude, limits.amplitude, factor)
        self.normalised = _sum(by_normalised, limits.normalised_amplitude, factor)
        self.others = nn.ModuleList(
            [copy.deepcopy(t).float().requires_grad_(requires_grad=False) for t in others]
        )
        self.has_amplitude: bool = bool(by_amplitude)
        self.has_normalised: bool = bool(by_normalised)
        self.has_others: bool = bool(others)
        self.needs_amplitude: bool = model.needs_amplitude()
        left_over = self.distance.left_over + self.amplitude.left_over + self.normalised.left_over
        offset = factor * (model.pixel_error().detach() + left_over)
        self.register_buffer("offset", offset.float().contiguous())

    def add_others(self, total: Tensor, radial_distance: Tensor, amplitude: Tensor) -> None:
        """Add the terms that are no polynomials to `total`."""
        for term in self.others:
            total.add_(term(radial_distance, amplitude), alpha=self.factor)


def _sum(terms: list, interval: Interval, factor: float) -> RuntimePolynomial:
    """Return the sum of polynomials in one variable, which share its scaling."""
    if not terms:
        return RuntimePolynomial(torch.zeros(0), 0.0, 1.0, interval, factor)
    coefficients = torch.zeros(max(len(term.coefficients) for term in terms)).double()
    for term in terms:
        coefficients[: len(term.coefficients)] += term.coefficients.detach()
    return RuntimePolynomial(coefficients, terms[0].centre, terms[0].half_width, interval, factor)
