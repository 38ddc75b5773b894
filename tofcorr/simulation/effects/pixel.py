"""Smooth error over the image, of higher order than a quadratic, or growing with the distance."""

from torch import Tensor

from tofcorr.geometry.polynomials import exponents, products
from tofcorr.options import Options
from tofcorr.simulation.effects.base import (
    Coefficient,
    EffectInputs,
    LinearDelay,
    side_by_side,
    terms_in,
)


class PixelShape(Options):
    """Degree of the surface over the image, and the distance at which it applies."""

    degree: int = 4
    reference_distance_m: float = 1.5


class PixelEffect(LinearDelay, shape=PixelShape):
    r"""A smooth surface over the image, plus one that grows with the distance.

    .. math:: \Delta d = \sum_{1 \le i+j \le K} p_{ij} P_i(x) P_j(y)
              + (d / d_0 - 1) (g_x x + g_y y + g_r (x^2 + y^2))

    with columns x and rows y scaled to [-1, 1]: P1 of Fuchs and May (2007), P2 of Abdo and
    Borgeat (2010), and higher orders.

    Source: Fuchs and May 2007; Abdo and Borgeat 2010.
    """

    name = "pixel"
    refines = ("pixel",)
    summary = "smooth error over the image, of higher order than the base model"
    remedy = "a white wall, frontal, at three or more distances, with the camera rolled"
    prior, decay = 0.04, 1.3

    @classmethod
    def for_recording(cls, inputs: EffectInputs) -> "PixelEffect":
        """Take the mean distance of the recording as reference."""
        return cls(PixelShape(reference_distance_m=float(inputs.radial_distance.mean())))

    @classmethod
    def terms(cls, shape: PixelShape) -> tuple[Coefficient, ...]:
        """Return the surface's coefficients, then those that grow with the distance."""
        surface, prior = exponents(1, shape.degree), cls.prior
        sizes = {f"x{i}_y{j}": prior / (i + j) ** cls.decay for i, j in surface}
        growth = {f"growth_{part}": prior / 2 for part in ("x", "y", "r2")}
        return terms_in("m", sizes | growth)

    def columns(self, inputs: EffectInputs) -> Tensor:
        """Return the functions of image position and distance, shape (M, K)."""
        x, y = inputs.columns, inputs.rows
        growth = inputs.radial_distance / self.shape.reference_distance_m - 1
        growing = [growth * part for part in (x, y, x**2 + y**2)]
        return side_by_side([*products(x, y, 1, self.shape.degree), *growing])
