"""The whole error model: one constant and its terms."""

from typing import Annotated

import torch
from pydantic import Field
from torch import Tensor, nn

from tofcorr.error_terms.amplitude import AmplitudePolynomial, AmplitudePolynomialOptions
from tofcorr.error_terms.base import PixelTerm, SignalTerm
from tofcorr.error_terms.distance import DistancePolynomial, DistancePolynomialOptions
from tofcorr.error_terms.domain import Domain
from tofcorr.error_terms.pixel import PixelPolynomial, PixelPolynomialOptions
from tofcorr.options import Options

TermOptions = Annotated[
    DistancePolynomialOptions | AmplitudePolynomialOptions | PixelPolynomialOptions,
    Field(discriminator="kind"),
]

_TERMS: dict[type[Options], type[SignalTerm] | type[PixelTerm]] = {
    DistancePolynomialOptions: DistancePolynomial,
    AmplitudePolynomialOptions: AmplitudePolynomial,
    PixelPolynomialOptions: PixelPolynomial,
}


class ErrorModelOptions(Options):
    """Which terms the error is made of; none leaves the constant alone."""

    terms: tuple[TermOptions, ...] = ()


class ErrorModel(nn.Module):
    r"""Predicted error of a pixel, the composition of terms.

    .. math:: E(v) = e_0 + \sum_s S_s(D_v, I_v) + \sum_p P_p(r_v, c_v)

    Sign: error = measured - true, in metres along the ray.

    Args:
        options: The terms, in order.
        domain: Image size and ranges, which scale the variables.

    Shape:
        - Input: `(..., H, W)`, radial distances in metres and amplitudes in the camera's units.
        - Output: `(..., H, W)`, predicted errors in metres.
    """

    def __init__(self, options: ErrorModelOptions, domain: Domain) -> None:
        super().__init__()
        self.constant = nn.Parameter(torch.zeros((), dtype=torch.float64))
        built = [_TERMS[type(term)](term, domain) for term in options.terms]  # type: ignore[arg-type]
        self.signal_terms = nn.ModuleList([term for term in built if isinstance(term, SignalTerm)])
        self.pixel_terms = nn.ModuleList([term for term in built if isinstance(term, PixelTerm)])
        self.height: int = domain.height
        self.width: int = domain.width

    def needs_amplitude(self) -> bool:
        """Whether any term looks at the amplitude."""
        return any(bool(term.needs_amplitude) for term in self.signal_terms)

    def symbols(self) -> list[str]:
        """The coefficients' names, in the order of `coefficient_vector`."""
        return ["c0", *(symbol for term in self._terms() for symbol in term.symbols)]

    def pixel_error(self) -> Tensor:
        """Return what does not change from frame to frame: constant plus P, shape (H, W)."""
        rows = torch.arange(self.height).to(self.constant)[:, None]
        columns = torch.arange(self.width).to(self.constant)[None, :]
        rows, columns = torch.broadcast_tensors(rows, columns)
        error = self.constant.expand(self.height, self.width)
        for term in self.pixel_terms:
            error = error + term(rows, columns)
        return error

    def forward(self, radial_distance: Tensor, amplitude: Tensor) -> Tensor:
        """Return the predicted error, shape (..., H, W), metres."""
        error = self.pixel_error()
        for term in self.signal_terms:
            error = error + term(radial_distance, amplitude)
        return error.expand(radial_distance.shape)

    def coefficient_vector(self) -> Tensor:
        """Return constant and coefficients as one vector, detached, float64."""
        return torch.cat([p.detach().reshape(-1) for p in self._ordered()])

    def set_coefficient_vector(self, values: Tensor) -> None:
        """Take constant and coefficients from one vector; inverse of `coefficient_vector`."""
        start = 0
        for parameter in self._ordered():
            part = values[start : start + parameter.numel()].detach()
            parameter.data.copy_(part.reshape(parameter.shape))
            start += parameter.numel()

    def paper_coefficients(self) -> dict[str, dict[str, float]]:
        """Return the coefficients in the paper's symbols, on unscaled variables.

        One group a letter (`distance`, `pixel`, `intensity`), since the paper calls two things
        c0. The three constants c0, p0 and i0 cannot be told apart: their sum is distance c0.
        """
        constant = float(self.constant.detach())
        groups: dict[str, dict[str, float]] = {"distance": {}}
        for term in self._terms():
            values, left_over = term.paper_coefficients()
            constant += left_over
            groups.setdefault(term.group, {}).update(values)
        groups["distance"] = {"c0": constant} | groups["distance"]
        return groups

    def set_paper_coefficients(self, groups: dict[str, dict[str, float]]) -> None:
        """Take coefficients in the paper's symbols; inverse of `paper_coefficients`.

        Raises:
            KeyError: A coefficient of a term is missing.
        """
        constant = groups["distance"]["c0"]
        for term in self._terms():
            constant += term.set_paper_coefficients(groups[term.group])
        self.constant.data.fill_(constant)

    def _terms(self) -> list[SignalTerm | PixelTerm]:
        return [*self.signal_terms, *self.pixel_terms]  # type: ignore[list-item]

    def _ordered(self) -> list[nn.Parameter]:
        return [self.constant, *(term.coefficients for term in self._terms())]
