"""A target that is not flat."""

from typing import Self

from torch import Tensor

from tofcorr.geometry.polynomials import exponents, products
from tofcorr.options import Options
from tofcorr.simulation.effects.base import (
    FIXED_TARGET,
    Coefficient,
    EffectInputs,
    LinearEffect,
    inputs_from_state,
    side_by_side,
    terms_in,
)
from tofcorr.simulation.hooks import FrameState


class AreaShape(Options):
    """The area of the target that the camera saw."""

    low_xy_m: tuple[float, float] = (-1.0, -1.0)
    high_xy_m: tuple[float, float] = (1.0, 1.0)

    @classmethod
    def seen(cls, inputs: EffectInputs, **others: float) -> Self:
        """Return the area that the camera saw, and other constants."""
        xy = inputs.target_xy
        ends = {"low_xy_m": xy.amin(0).tolist(), "high_xy_m": xy.amax(0).tolist()}
        return cls.model_validate({**ends, **others})

    def scaled(self, xy: Tensor) -> tuple[Tensor, Tensor]:
        """Return x and y of points (M, 2), -1 to 1 within the area; beyond it that of its edge."""
        low, high = xy.new_tensor(self.low_xy_m), xy.new_tensor(self.high_xy_m)
        x, y = (2 * (xy - low) / (high - low) - 1).clamp(-1.0, 1.0).unbind(-1)
        return x, y


class TargetShapeShape(AreaShape):
    """The area that is described, and the degree; beyond it the height is that of its edge."""

    degree: int = 6


class TargetShapeEffect(LinearEffect, shape=TargetShapeShape):
    r"""A surface with bumps.

    .. math:: \Delta d = -h(x, y) / \cos \theta, \quad
              h = \sum_{2 \le i+j \le K} h_{ij} P_i(x) P_j(y)

    with the height h above the plane, towards the camera, over the target's own coordinates.
    Height and tilt of the whole plane are `target_registration`.

    Source: geometry of a ray that meets a raised surface.
    """

    name = "target_shape"
    summary = "a target that is not flat"
    remedy = "look at another part of the target, or rotate it in its plane"
    needs = (FIXED_TARGET,)
    prior = 0.03

    @classmethod
    def for_recording(cls, inputs: EffectInputs) -> Self:
        """Describe the area that the camera saw."""
        return cls(TargetShapeShape.seen(inputs))

    @classmethod
    def terms(cls, shape: TargetShapeShape) -> tuple[Coefficient, ...]:
        """Return the heights; the prior is smaller for shorter waves."""
        heights = exponents(2, shape.degree)
        return terms_in("m", {f"x{i}_y{j}": cls.prior / (i + j) for i, j in heights})

    def columns(self, inputs: EffectInputs) -> Tensor:
        """Return how much earlier the ray meets the surface per unit of each height, (M, K)."""
        x, y = self.shape.scaled(inputs.target_xy)
        heights = side_by_side(products(x, y, 2, self.shape.degree))
        return -heights / inputs.incidence_cosine[:, None]

    def on_geometry(self, state: FrameState) -> None:
        """Raise the surface."""
        shift = self.shift(inputs_from_state(state), self.coefficients)
        shift = shift.reshape(state.radial_distance.shape)
        rays_world = state.ray_directions @ state.world_from_camera[:3, :3].T
        state.radial_distance = state.radial_distance + shift
        state.points_world = state.points_world + shift[..., None] * rays_world
