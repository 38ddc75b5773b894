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
from tofcorr.error_terms.residual import ResidualNetwork


class RuntimeErrorModel(nn.Module):
    """The predicted error times a factor, taken apart for the corrector.

    Constant and pixel terms become one image. Polynomials in the distance, in the amplitude and
    in the distance-normalised amplitude run in place; every other term runs as it is, in float32.
    What the frame's conditions add is one number, which `set_conditions` adds to the image.

    Args:
        model: The float64 model.
        limits: Ranges of the variables.
        factor: What to multiply by; a power of two, so that it costs no accuracy.

    Attributes:
        offset: Constant and pixel terms, times the factor, shape (H, W), float32.
        rows: Row numbers, shape (H, 1), float32.
        columns: Column numbers, shape (1, W), float32.
    """

    offset: Tensor
    offset_at_mean: Tensor
    rows: Tensor
    columns: Tensor

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
        self.condition_terms = copy.deepcopy(model.condition_terms).requires_grad_(
            requires_grad=False
        )
        self.has_conditions: bool = len(model.condition_terms) > 0
        unconditional = self.offset.clone() if self.has_conditions else self.offset[:0]
        self.register_buffer("offset_at_mean", unconditional)
        self.network: ResidualNetwork | None = None
        if model.residual is not None:
            network = copy.deepcopy(model.residual).float()
            self.network = network.requires_grad_(requires_grad=False)
        self.has_network: bool = model.residual is not None
        rows, columns = model.pixel_grid()
        self.register_buffer("rows", rows.detach().float())
        self.register_buffer("columns", columns.detach().float())

    def add_others(self, total: Tensor, radial_distance: Tensor, amplitude: Tensor) -> None:
        """Add the terms that are no polynomials to `total`."""
        for term in self.others:
            total.add_(term(radial_distance, amplitude), alpha=self.factor)

    def add_network(
        self, total: Tensor, radial_distance: Tensor, amplitude: Tensor, rows: Tensor
    ) -> None:
        """Add the residual network to `total`; it sees distances and amplitudes as they are."""
        if self.network is not None:
            found = self.network(radial_distance, amplitude, rows, self.columns)
            total.add_(found, alpha=self.factor)

    def set_conditions(self, conditions: Tensor) -> bool:
        """Take a frame's conditions (C,) into the image; return whether they are in range."""
        if not self.has_conditions:
            return True
        error = torch.zeros_like(conditions[0])
        inside = True
        for term in self.condition_terms:
            error = error + term(conditions)
            inside = inside and term.inside(conditions)  # type: ignore[operator]
        self.offset.copy_(self.offset_at_mean + self.factor * float(error))
        return inside


def _sum(terms: list, interval: Interval, factor: float) -> RuntimePolynomial:
    """Return the sum of polynomials in one variable, which share its scaling."""
    if not terms:
        return RuntimePolynomial(torch.zeros(0), 0.0, 1.0, interval, factor)
    coefficients = torch.zeros(max(len(term.coefficients) for term in terms)).double()
    for term in terms:
        coefficients[: len(term.coefficients)] += term.coefficients.detach()
    return RuntimePolynomial(coefficients, terms[0].centre, terms[0].half_width, interval, factor)
