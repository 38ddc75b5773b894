"""The error of a camera that warms up, over the time since the recording began."""

from typing import ClassVar, Literal

import torch
from pydantic import PositiveFloat
from torch import Tensor

from tofcorr.error_terms.base import ConditionTerm
from tofcorr.error_terms.domain import Domain
from tofcorr.error_terms.term_options import BaseTermOptions

# So many time constants (no unit) make up the recording's duration, at least one second, until a
# fit has found the time constant. Set by hand: after three the drift is over but for 5 %.
_CONSTANTS_A_RECORDING = 3


class WarmUpOptions(BaseTermOptions):
    """Options of `WarmUp`.

    Attributes:
        time_constants_s: Time constants of the exponentials, seconds; `auto` finds one in the data.
    """

    kind: Literal["warm_up"] = "warm_up"
    time_constants_s: Literal["auto"] | tuple[PositiveFloat, ...] = "auto"
    needs: ClassVar[tuple[str, ...]] = ("timestamp",)
    found_in_data: ClassVar[tuple[str, ...]] = ("time_constants_s",)


class WarmUp(ConditionTerm):
    r"""Drift of a camera that warms up: exponentials in the time since the recording began.

    .. math:: E(t) = \sum_k w_k \left(e^{-t / \tau_k} - e^{-\bar t / \tau_k}\right)

    Kahlmann et al. (2006) saw distances settle within minutes after power on. The amplitudes w_k
    are coefficients; the fit finds the time constants.

    Args:
        options: The time constants; `auto` starts at a third of the recording.
        domain: Mean and range of the time.

    Shape:
        - Input: `(*, C)`, conditions in the order of `CONDITIONS`.
        - Output: `(*)`, predicted errors in metres.
    """

    rates: Tensor

    def __init__(self, options: WarmUpOptions, domain: Domain) -> None:
        chosen = options.time_constants_s
        number = 1 if chosen == "auto" else len(chosen)
        names = [f"w{k}" for k in range(1, number + 1)]
        super().__init__(options, names, "timestamp", domain)
        span = float(self.high - self.low)
        constants = (max(span, 1.0) / _CONSTANTS_A_RECORDING,) if chosen == "auto" else chosen
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
        return (self.decay(conditions) * self.coefficients).sum(-1)
