"""Error that depends on the amplitude, of higher order than the base model's quadratic."""

import math

from torch import Tensor

from tofcorr.errors import CalibrationDataError
from tofcorr.geometry.polynomials import legendre
from tofcorr.options import Options
from tofcorr.simulation.effects.base import (
    AMPLITUDE,
    Coefficient,
    EffectInputs,
    LinearDelay,
    inner_range,
    side_by_side,
    terms_in,
)


class AmplitudeShape(Options):
    """The range of amplitudes; beyond it the error is constant."""

    low_counts: float = 50.0
    high_counts: float = 5000.0
    degree: int = 5


class AmplitudeEffect(LinearDelay, shape=AmplitudeShape):
    r"""Any smooth error that depends on the amplitude only.

    .. math:: \Delta d = \sum_{k=1}^{K} l_k P_k(u) + i_1 w + i_2 w^2

    with u the logarithm of the amplitude scaled to [-1, 1] and w the amplitude itself over its
    maximum: I1 of Abdo and Borgeat (2010), and the error of dark surfaces (Lindner and Kolb 2007).

    Source: Lindner and Kolb 2007.
    """

    name = "amplitude"
    refines = ("intensity", "distance_amplitude")
    summary = "error of weak or strong signals, of higher order than the base model"
    remedy = "a grey ladder of five reflectivities at one distance, with three integration times"
    needs = (AMPLITUDE,)
    prior_linear = 0.03

    @classmethod
    def for_recording(cls, inputs: EffectInputs) -> "AmplitudeEffect":
        """Take the range of nearly all amplitudes.

        Raises:
            CalibrationDataError: No amplitude is above zero.
        """
        known = inputs.known_amplitude
        if not bool((known > 0).any()):
            said = "amplitude.npy holds 0 in every pixel used, so it was not measured"
            raise CalibrationDataError(f"{said}: remove the file; what is missing is unknown.")
        low, high = inner_range(known[known > 0])
        return cls(AmplitudeShape(low_counts=low, high_counts=high))

    @classmethod
    def terms(cls, shape: AmplitudeShape) -> tuple[Coefficient, ...]:
        """Return the coefficients of the logarithm, then of the amplitude itself."""
        sizes = {f"log_{k}": 2 * cls.prior / (1 + k / 2) for k in range(1, shape.degree + 1)}
        return terms_in("m", sizes | dict.fromkeys(("linear", "square"), cls.prior_linear))

    def columns(self, inputs: EffectInputs) -> Tensor:
        """Return the functions of the amplitude, shape (M, K)."""
        low, high = self.shape.low_counts, self.shape.high_counts
        amplitude = inputs.known_amplitude.clamp(low, high)
        scaled = 2 * (amplitude / low).log() / (math.log(high / low) or 1.0) - 1
        share = amplitude / high
        return side_by_side([*legendre(scaled, self.shape.degree)[1:], share, share**2])
