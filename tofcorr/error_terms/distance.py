"""The error that depends on distance alone, D."""

from typing import ClassVar, Literal

from torch import Tensor

from tofcorr.error_terms.base import SignalTerm
from tofcorr.error_terms.domain import Domain
from tofcorr.error_terms.polynomial import (
    ScaledPolynomial,
    horner,
    powers,
    rescale,
    unit_of_power,
    unscale,
)
from tofcorr.error_terms.term_options import BaseTermOptions
from tofcorr.options.numbers import Degree


class DistancePolynomialOptions(BaseTermOptions):
    """Options of `DistancePolynomial`."""

    kind: Literal["distance_polynomial"] = "distance_polynomial"
    degree: Degree = 3
    grows_with: ClassVar[str | None] = "degree"


class DistancePolynomial(SignalTerm):
    r"""Polynomial in the measured radial distance (Abdo and Borgeat 2010: cubic, below 2 m).

    .. math:: D(u) = \sum_{k=1}^{K} c'_k u^k, \quad u = (D - \bar D) / h

    Args:
        options: The degree K.
        domain: The range of distances gives the centre and half-width h.

    Shape:
        - Input: `(*)`, measured radial distances in metres (amplitudes are not read).
        - Output: `(*)`, predicted errors in metres.

    Example:
        >>> import torch
        >>> from tofcorr.error_terms.domain import Domain, Interval
        >>> domain = Domain(height=4, width=4, radial_distance=Interval(1.0, 3.0))
        >>> term = DistancePolynomial(DistancePolynomialOptions(degree=1), domain)
        >>> _ = term.coefficients.data.fill_(0.01)
        >>> distance = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)
        >>> term(distance, distance).tolist()
        [-0.01, 0.0, 0.01]
    """

    centre: Tensor
    half_width: Tensor

    def __init__(self, options: DistancePolynomialOptions, domain: Domain) -> None:
        symbols = [f"c{k}" for k in range(1, options.degree + 1)]
        super().__init__(options, "distance", symbols)
        self.degree: int = options.degree
        self.register_number("centre", domain.radial_distance.centre)
        self.register_number("half_width", domain.radial_distance.half_width)

    def basis(self, radial_distance: Tensor, amplitude: Tensor) -> Tensor:
        """Return u, u^2, ..., shape (K, ...)."""
        return powers((radial_distance - self.centre) / self.half_width, self.degree)

    def forward(self, radial_distance: Tensor, amplitude: Tensor) -> Tensor:
        """Return the predicted error, shape (...), metres."""
        return horner(self.coefficients, (radial_distance - self.centre) / self.half_width)

    def polynomial(self) -> ScaledPolynomial:
        """Return the term as a polynomial in the distance."""
        return ScaledPolynomial(
            "distance", self.coefficients, float(self.centre), float(self.half_width)
        )

    def paper_coefficients(self) -> tuple[dict[str, float], float]:
        """Return c1, c2, ... in metres per metre^k, and the constant that remains, metres."""
        constant, *raw = unscale(self.coefficients, float(self.centre), float(self.half_width))
        return dict(zip(self.symbols, raw, strict=True)), constant

    def paper_units(self) -> dict[str, str]:
        """Return metres per metre^k for c1, c2, ..."""
        return {symbol: unit_of_power("m", k) for k, symbol in enumerate(self.symbols, start=1)}

    def set_paper_coefficients(self, values: dict[str, float]) -> float:
        """Set c1, c2, ... of the paper; return the constant they add, metres."""
        raw = [values[symbol] for symbol in self.symbols]
        scaled, constant = rescale(raw, float(self.centre), float(self.half_width))
        self.coefficients.data.copy_(self.coefficients.new_tensor(scaled))
        return constant
