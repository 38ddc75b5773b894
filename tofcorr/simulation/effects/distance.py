"""Error that depends on the distance, of higher order than a cubic."""

from torch import Tensor

from tofcorr.geometry.polynomials import legendre
from tofcorr.options import Options
from tofcorr.simulation.effects.base import (
    Coefficient,
    EffectInputs,
    LinearDelay,
    side_by_side,
    terms_in,
)


class DistanceShape(Options):
    """The range of distances; beyond it the error is constant."""

    low_m: float = 0.5
    high_m: float = 3.0
    degree: int = 9


class DistanceEffect(LinearDelay, shape=DistanceShape):
    r"""Any smooth error that depends on the distance only.

    .. math:: \Delta d = \sum_{k=1}^{K} c_k P_k(u), \quad u = 2 (d - d_0) / (d_1 - d_0) - 1

    with Legendre polynomials P_k: the cubic of Abdo and Borgeat (2010), and the finer structure
    that a B-spline (Lindner and Kolb 2006) or a table (Kahlmann et al. 2006) describes.

    Source: Lindner and Kolb 2006; Kahlmann et al. 2006.
    """

    name = "distance"
    refines = ("distance", "distance_amplitude")
    summary = "error of the distance alone, of higher order than the base model"
    remedy = "more distances over the whole range, at one tilt and one reflectivity"
    prior, decay = 0.06, 1.3

    @classmethod
    def for_recording(cls, inputs: EffectInputs) -> "DistanceEffect":
        """Take the range from the nearest to the farthest pixel."""
        low, high = inputs.radial_distance.min(), inputs.radial_distance.max()
        return cls(DistanceShape(low_m=float(low), high_m=float(high)))

    @classmethod
    def terms(cls, shape: DistanceShape) -> tuple[Coefficient, ...]:
        """Return c1, c2, ...; the prior is smaller for higher degrees."""
        sizes = {f"legendre_{k}": cls.prior / k**cls.decay for k in range(1, shape.degree + 1)}
        return terms_in("m", sizes)

    def columns(self, inputs: EffectInputs) -> Tensor:
        """Return the Legendre polynomials, shape (M, K)."""
        low, high = self.shape.low_m, self.shape.high_m
        scaled = 2 * (inputs.radial_distance - low) / ((high - low) or 1.0) - 1
        return side_by_side(legendre(scaled.clamp(-1.0, 1.0), self.shape.degree)[1:])
