"""The error that depends on the circumstances of a frame: exposure, temperature, time."""

from typing import ClassVar, Literal

import torch
from pydantic import Field, PositiveFloat, PositiveInt
from torch import Tensor

from tofcorr.conditions import CONDITIONS
from tofcorr.error_terms.base import ConditionTerm
from tofcorr.error_terms.domain import Domain
from tofcorr.error_terms.polynomial import horner, powers
from tofcorr.errors import CalibrationDataError
from tofcorr.options import Options


class IntegrationTimeOptions(Options):
    """Options of a `ConditionPolynomial` in the integration time."""

    kind: Literal["integration_time"] = "integration_time"
    degree: PositiveInt = Field(default=1, le=5)
    needs: ClassVar[tuple[str, ...]] = ("integration_time",)


class RoomTemperatureOptions(Options):
    """Options of a `ConditionPolynomial` in the room's temperature."""

    kind: Literal["room_temperature"] = "room_temperature"
    degree: PositiveInt = Field(default=1, le=5)
    needs: ClassVar[tuple[str, ...]] = ("room_temperature",)


class WarmUpOptions(Options):
    """Options of `WarmUp`.

    Attributes:
        time_constants_s: One number an exponential; `auto` finds one time constant in the data.
    """

    kind: Literal["warm_up"] = "warm_up"
    time_constants_s: Literal["auto"] | tuple[PositiveFloat, ...] = "auto"
    needs: ClassVar[tuple[str, ...]] = ("timestamp",)


class ConditionPolynomial(ConditionTerm):
    r"""Polynomial in one circumstance of a frame.

    .. math:: E(u) = \sum_{k=1}^{K} h_k u^k, \quad u = (x - \bar x) / w

    with x the integration time or the room's temperature, held at its calibrated range. Kahlmann,
    Remondino and Ingensand (2006) measured both: another curve for every integration time, and
    about 8 mm for every degree.

    Args:
        options: The degree.
        domain: Mean and range of the circumstance.

    Raises:
        CalibrationDataError: The circumstance is not known of every frame.

    Shape:
        - Input: `(*, C)`, conditions in the order of `CONDITIONS`.
        - Output: `(*)`, predicted errors in metres.
    """

    def __init__(
        self, options: IntegrationTimeOptions | RoomTemperatureOptions, domain: Domain
    ) -> None:
        letter = {"integration_time": "e", "room_temperature": "h"}[options.kind]
        names = [f"{letter}{k}" for k in range(1, options.degree + 1)]
        super().__init__(names, CONDITIONS.index(options.kind), _known(options.kind, domain))
        self.degree: int = options.degree
        self.half_width: float = (self.high - self.low) / 2 or 1.0

    def scaled(self, conditions: Tensor) -> Tensor:
        """Return the scaled circumstance u, shape (...)."""
        return (self.value(conditions) - self.mean) / self.half_width

    def basis(self, conditions: Tensor) -> Tensor:
        """Return u, u^2, ..., shape (K, ...)."""
        return powers(self.scaled(conditions), self.degree)

    def forward(self, conditions: Tensor) -> Tensor:
        """Return the predicted error, shape (...), metres."""
        return horner(self.coefficients, self.scaled(conditions))


class WarmUp(ConditionTerm):
    r"""Drift of a camera that warms up: exponentials in the time since the recording began.

    .. math:: E(t) = \sum_k w_k \left(e^{-t / \tau_k} - e^{-\bar t / \tau_k}\right)

    Kahlmann et al. (2006) saw distances settle within minutes after power on. The amplitudes are
    coefficients as all others; time constants are found by the fit.

    Args:
        options: The time constants; `auto` must have been replaced by a number.
        domain: Mean and range of the time.

    Shape:
        - Input: `(*, C)`, conditions in the order of `CONDITIONS`.
        - Output: `(*)`, predicted errors in metres.
    """

    rates: Tensor

    def __init__(self, options: WarmUpOptions, domain: Domain) -> None:
        known = _known("timestamp", domain)
        constants = options.time_constants_s
        if constants == "auto":
            constants = (max(known[1] - known[0], 1.0) / 3,)
        names = [f"w{k}" for k in range(1, len(constants) + 1)]
        super().__init__(names, CONDITIONS.index("timestamp"), known)
        self.register_buffer("rates", 1.0 / torch.tensor(constants, dtype=torch.float64))

    def decay(self, conditions: Tensor) -> Tensor:
        """Return each exponential less its value at the mean time, shape (..., K)."""
        time = self.value(conditions).unsqueeze(-1)
        return torch.exp(-time * self.rates) - torch.exp(-self.mean * self.rates)

    def basis(self, conditions: Tensor) -> Tensor:
        """Return the exponentials, shape (K, ...)."""
        return self.decay(conditions).movedim(-1, 0)

    def forward(self, conditions: Tensor) -> Tensor:
        """Return the predicted error, shape (...), metres."""
        return torch.matmul(self.decay(conditions), self.coefficients)


def _known(name: str, domain: Domain) -> tuple[float, float, float]:
    if name not in domain.conditions:
        raise CalibrationDataError(
            f"The model has a term of the {name.replace('_', ' ')}, which is not known of every "
            "frame: add the column to frames.csv, or choose a model without that term."
        )
    return domain.conditions[name]
