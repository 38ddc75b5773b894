"""Shift that depends on the integration time."""

import torch
from torch import Tensor

from tofcorr.conditions import condition
from tofcorr.options import Options
from tofcorr.simulation.effects.base import (
    INTEGRATION_TIME,
    Coefficient,
    EffectInputs,
    FrameEffect,
    known,
    terms_in,
)
from tofcorr.simulation.hooks import FrameFacts


class IntegrationTimeShape(Options):
    """The integration time at which there is no shift, and the degree of the curve."""

    reference_us: float = 1000.0
    degree: int = 3


class IntegrationTimeEffect(FrameEffect, shape=IntegrationTimeShape):
    r"""A shift with the logarithm of the integration time.

    .. math:: \Delta d = \sum_{k=1}^{K} a_k \ln^k (\tau / \tau_0)

    Longer exposure reads nearer by centimetres (Kahlmann et al. 2006; Lindner and Kolb 2007).
    K is at most the number of settings minus one: that is enough to fit every setting exactly.

    Source: Kahlmann et al. 2006; Lindner and Kolb 2007.
    """

    name = "integration_time"
    summary = "shift that depends on the integration time"
    remedy = "three or more integration times at the same poses, in random order"
    needs = (INTEGRATION_TIME,)
    linear = True
    prior = 0.03

    @classmethod
    def for_recording(cls, inputs: EffectInputs) -> "IntegrationTimeEffect":
        """Take the median setting as reference, and as many terms as the settings allow."""
        times = _microseconds(inputs.facts)
        degree = max(1, min(3, len(torch.unique(times.round())) - 1))
        return cls(IntegrationTimeShape(reference_us=float(times.median()), degree=degree))

    @classmethod
    def terms(cls, shape: IntegrationTimeShape) -> tuple[Coefficient, ...]:
        """Return the coefficients of the powers of the logarithm."""
        return terms_in("m", {f"log_{k}": cls.prior / k for k in range(1, shape.degree + 1)})

    def shifts(self, facts: FrameFacts, coefficients: Tensor) -> Tensor:
        """Return the polynomial of the logarithm, shape (F,), metres."""
        logarithm = (_microseconds(facts) / self.shape.reference_us).log()
        powers = [logarithm**k for k in range(1, self.shape.degree + 1)]
        return torch.stack(powers, dim=-1) @ coefficients


def _microseconds(facts: FrameFacts) -> Tensor:
    return condition("integration_time").in_file(known(facts, "integration_time"))
