"""The error as a polynomial in the integration time, or in the room's temperature."""

from typing import ClassVar, Literal

from pydantic import Field, PositiveInt
from torch import Tensor

from tofcorr.error_terms.base import ConditionTerm
from tofcorr.error_terms.domain import Domain
from tofcorr.error_terms.polynomial import horner, powers
from tofcorr.error_terms.term_options import BaseTermOptions


class IntegrationTimeOptions(BaseTermOptions):
    """Options of a `ConditionPolynomial` in the integration time."""

    kind: Literal["integration_time"] = "integration_time"
    degree: PositiveInt = Field(default=1, le=5)
    needs: ClassVar[tuple[str, ...]] = ("integration_time",)
    grows_with: ClassVar[str | None] = "degree"
    letter: ClassVar[str] = "e"


class RoomTemperatureOptions(BaseTermOptions):
    """Options of a `ConditionPolynomial` in the room's temperature."""

    kind: Literal["room_temperature"] = "room_temperature"
    degree: PositiveInt = Field(default=1, le=5)
    needs: ClassVar[tuple[str, ...]] = ("room_temperature",)
    grows_with: ClassVar[str | None] = "degree"
    letter: ClassVar[str] = "h"


class ConditionPolynomial(ConditionTerm):
    r"""Polynomial in one condition of a frame.

    .. math:: E(u) = \sum_{k=1}^{K} h_k u^k, \quad u = (x - \bar x) / w

    with x the integration time or the room's temperature, clamped to its calibrated range.
    Kahlmann, Remondino and Ingensand (2006) measured both: the error changes with the integration
    time, and by about 8 mm a degree Celsius.

    Args:
        options: The degree.
        domain: Mean and range of the condition.

    Raises:
        CalibrationDataError: The condition is not known of every frame.

    Shape:
        - Input: `(*, C)`, conditions in the order of `CONDITIONS`.
        - Output: `(*)`, predicted errors in metres.
    """

    half_width: Tensor

    def __init__(
        self, options: IntegrationTimeOptions | RoomTemperatureOptions, domain: Domain
    ) -> None:
        names = [f"{options.letter}{k}" for k in range(1, options.degree + 1)]
        super().__init__(options, names, options.needs[0], domain)
        self.degree: int = options.degree
        # A condition that did not change has no scale: any number does.
        self.register_number("half_width", float(self.high - self.low) / 2 or 1.0)

    def scaled(self, conditions: Tensor) -> Tensor:
        """Return the scaled condition u, shape (...)."""
        return (self.value(conditions) - self.mean) / self.half_width

    def basis(self, conditions: Tensor) -> Tensor:
        """Return u, u^2, ..., shape (K, ...)."""
        return powers(self.scaled(conditions), self.degree)

    def forward(self, conditions: Tensor) -> Tensor:
        """Return the predicted error, shape (...), metres."""
        return horner(self.coefficients, self.scaled(conditions))
