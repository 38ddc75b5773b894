"""The error model at runtime: float32, what never changes precomputed, few passes over memory."""

import copy

import torch
from torch import Tensor, nn

from tofcorr.correction.limits import Limits
from tofcorr.correction.runtime_polynomial import RuntimePolynomial
from tofcorr.error_terms.base import SignalTerm
from tofcorr.error_terms.bases import ScaledPolynomial
from tofcorr.error_terms.domain import Interval
from tofcorr.error_terms.model import ErrorModel
from tofcorr.error_terms.residual import ResidualNetwork


class RuntimeErrorModel(nn.Module):
    """The predicted error times a factor, in the form that is fastest to evaluate.

    Constant and pixel terms become one image. All polynomials in one variable become one
    polynomial, evaluated in place; every other term runs as it is, in float32. The condition terms
    of a frame sum to one number, which `set_conditions` adds to the image.

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
        sums, others = summed_polynomials(model)
        self.factor: float = factor
        self.distance = _runtime(sums.get("distance"), limits.radial_distance, factor)
        self.amplitude = _runtime(sums.get("amplitude"), limits.amplitude, factor)
        self.normalised = _runtime(
            sums.get("normalised_amplitude"), limits.normalised_amplitude, factor
        )
        self.others = nn.ModuleList(
            [copy.deepcopy(t).float().requires_grad_(requires_grad=False) for t in others]
        )
        self.has_amplitude: bool = "amplitude" in sums
        self.has_normalised: bool = "normalised_amplitude" in sums
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
        """Add the terms that are not polynomials to `total`."""
        for term in self.others:
            total.add_(term(radial_distance, amplitude), alpha=self.factor)

    def add_network(
        self, total: Tensor, radial_distance: Tensor, amplitude: Tensor, rows: Tensor
    ) -> None:
        """Add the residual network to `total`; its inputs are not clamped."""
        if self.network is not None:
            found = self.network(radial_distance, amplitude, rows, self.columns)
            total.add_(found, alpha=self.factor)

    def set_conditions(self, conditions: Tensor) -> bool:
        """Add the condition terms of a frame (C,) to the image; return whether it is in range."""
        if not self.has_conditions:
            return True
        error = torch.zeros_like(conditions[0])
        inside = True
        for term in self.condition_terms:
            error = error + term(conditions)
            inside = inside and term.inside(conditions)  # type: ignore[operator]
        self.offset.copy_(self.offset_at_mean + self.factor * float(error))
        return inside


def summed_polynomials(model: ErrorModel) -> tuple[dict[str, ScaledPolynomial], list[SignalTerm]]:
    """Return the sum of the polynomials in each variable, and the terms that are in none."""
    sums: dict[str, ScaledPolynomial] = {}
    others: list[SignalTerm] = []
    for term in model.signal_terms:
        own: ScaledPolynomial | None = term.polynomial()  # type: ignore[operator, assignment]
        before = own and sums.get(own.variable)
        if own is None or (before and before[2:] != own[2:]):
            others.append(term)  # type: ignore[arg-type]
        else:
            sums[own.variable] = _added(before, own) if before else own
    return sums, others


def _added(first: ScaledPolynomial, second: ScaledPolynomial) -> ScaledPolynomial:
    """Return the sum of two polynomials of one scaling."""
    size = max(len(first.coefficients), len(second.coefficients))
    total = torch.zeros(size).double()
    for one in (first, second):
        total[: len(one.coefficients)] += one.coefficients.detach().cpu()
    return first._replace(coefficients=total)


def _runtime(
    sum_of: ScaledPolynomial | None, interval: Interval, factor: float
) -> RuntimePolynomial:
    if sum_of is None:
        return RuntimePolynomial(torch.zeros(0), 0.0, 1.0, interval, factor)
    return RuntimePolynomial(
        sum_of.coefficients, sum_of.centre, sum_of.half_width, interval, factor
    )
