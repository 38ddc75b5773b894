"""A polynomial of one signal variable at runtime: float32, and one pass over memory a degree."""

import numpy as np
import torch
from torch import Tensor, nn

from tofcorr.error_terms.bases import unscale
from tofcorr.error_terms.domain import Interval

# Largest error of a polynomial by rounding to float32, metres. A fifth of the 1e-6 m to which an
# export must agree with the model.
_ROUNDING_BUDGET = 2e-7
# Number of points over the range at which that error is measured. Set by hand: a polynomial of
# low degree is smooth between them.
_NUM_PROBES = 4097


class RuntimePolynomial(nn.Module):
    """Sum of c_k (x - shift)^k, k = 1..K, with the scaling of the variable folded into c_k.

    Where float32 allows it the shift is folded in as well, which saves one pass over memory. That
    leaves a constant, `left_over`, which the caller adds.

    Args:
        scaled: Coefficients of u, u^2, ... with u = (x - centre) / half_width; may be empty.
        centre: Centre of the scaled variable.
        half_width: Its half-width.
        interval: The range of x.
        factor: What to multiply the polynomial by.
    """

    coefficients: Tensor
    values: list[float]

    def __init__(
        self,
        scaled: Tensor,
        centre: float,
        half_width: float,
        interval: Interval,
        factor: float,
    ) -> None:
        super().__init__()
        scaled = scaled.detach().double().cpu()
        constant, *raw = unscale(scaled, centre, half_width)
        self.degree: int = len(raw)
        self.shift: float = 0.0
        if raw and _rounding([constant, *raw], interval) > _ROUNDING_BUDGET:
            raw = [float(c) / half_width**k for k, c in enumerate(scaled, start=1)]
            constant = 0.0
            self.shift = centre
        self.left_over: float = constant
        self.values = [factor * value for value in raw]
        self.register_buffer("coefficients", torch.tensor(self.values, dtype=torch.float32))

    def forward(self, offset: Tensor, variable: Tensor, out: Tensor) -> Tensor:
        """Return offset + p(variable), written to `out`, shape of `variable`."""
        if self.degree == 0:
            return torch.add(offset, variable, alpha=0.0, out=out)
        x = self.shifted(variable)
        if self.degree == 1:
            return torch.add(offset, x, alpha=self.values[0], out=out)
        return torch.addcmul(offset, x, self.inner(x, out), out=out)

    def add_to(self, total: Tensor, variable: Tensor) -> None:
        """Add p(variable) to `total`."""
        x = self.shifted(variable)
        if self.degree > 2:
            total.addcmul_(x, self.inner(x, torch.empty_like(x)))
        else:
            total.add_(x, alpha=self.values[0])
            if self.degree == 2:
                total.addcmul_(x, x, value=self.values[1])

    def shifted(self, variable: Tensor) -> Tensor:
        """Return variable - shift."""
        return variable - self.shift if self.shift != 0.0 else variable

    def inner(self, x: Tensor, out: Tensor) -> Tensor:
        """Return p(x) / x for a degree of at least 2, by Horner's rule, written to `out`."""
        highest = self.values[self.degree - 1]
        value = torch.add(self.coefficients[self.degree - 2], x, alpha=highest, out=out)
        for k in range(self.degree - 3, -1, -1):
            torch.addcmul(self.coefficients[k], x, value, out=value)
        return value


def _rounding(raw: list[float], interval: Interval) -> float:
    """Return the largest error of Horner's rule in float32, with coefficients of 1, x, ..."""
    x = np.linspace(*interval, _NUM_PROBES).astype(np.float32)
    exact, rounded = np.zeros(_NUM_PROBES), np.zeros(_NUM_PROBES, dtype=np.float32)
    for coefficient in reversed(raw):
        exact = exact * x + coefficient
        rounded = rounded * x + np.float32(coefficient)
    return float(np.abs(exact - rounded).max())
