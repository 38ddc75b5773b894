"""Light that reaches the target by a wall or the floor."""

import itertools
import math
from typing import Any, Self

import torch
from torch import Tensor

from tofcorr.geometry import se3
from tofcorr.geometry.polynomials import exponents, products
from tofcorr.geometry.rays import AT_ONCE, SPEED_OF_LIGHT, ray_directions
from tofcorr.options import Number, PositiveNumber
from tofcorr.scene_light.bounces import SecondBouncesState
from tofcorr.scene_light.surroundings import (
    CameraLight,
    Surroundings,
    bounced,
    sampled,
    surroundings_of,
)
from tofcorr.simulation.effects.base import (
    FIXED_TARGET,
    FREQUENCY,
    CatalogueEffect,
    Coefficient,
    EffectInputs,
    ErrorElsewhere,
    SignalEffect,
    inner_range,
    inputs_from_state,
    known,
    side_by_side,
)
from tofcorr.simulation.effects.surface import LEAST_COSINE
from tofcorr.simulation.effects.target_shape import AreaShape
from tofcorr.simulation.hooks import FrameState

SIDES = ("left", "right", "below", "above")
"""Where surfaces stand: before and after the target along its first axis, and its second."""
BEYOND = {"near": 0.05, "far": 0.4}
"""Distance of a surface from the edge of the field of view on the target, in widths of that field.
Set by hand: a surface close by, and one farther away."""
# Rows of patches of a surface end at these distances from the target, in widths of the field. Each
# has three patches along the edge, as wide together as the rows are deep. Set by hand: nine patches
# sum up to a smooth surface where it matters, near the target.
_ROWS = (0.0, 0.1, 0.3, 0.7)

SECOND_BOUNCES = "second_bounces"
"""Name of the coefficient of second bounces by surfaces that the frames show."""
_CONES = (1.0, 1.2, 1.4)
"""Half angles of the light that are tried, over that of the image's corners. Chosen: light beyond
the image is lost, so that no camera sends much of it."""


def light_by_surfaces(
    xy: Tensor, camera: Tensor, distance: Tensor, cosine: Tensor, area: AreaShape, turn: float
) -> Tensor:
    """Return the light by each surface at reflectivity one, relative to the direct light.

    Args:
        xy: Points of the target in its coordinates, shape (M, 2), metres.
        camera: The camera that sees each point, height positive, shape (M, 3), metres.
        distance: From the camera, shape (M,), metres.
        cosine: Of the angle of incidence, shape (M,).
        area: Of the target that was seen.
        turn: Radians a metre of distance.

    Returns:
        Complex, shape (M, 8), in the order of `SIDES` and `BEYOND`.
    """
    low, high = area.low_xy_m, area.high_xy_m
    extent = max(high[0] - low[0], high[1] - low[1])
    # Along the last axes: where a patch lies along the edge, and how high. A patch nearer than the
    # lowest is high is no point source.
    ends = extent * xy.new_tensor(_ROWS)
    up, depth, width = (ends[1:] + ends[:-1]) / 2, ends.diff(), ends[-1] / 3
    aside, height = width * xy.new_tensor([[-1], [0], [1]]), camera[:, 2, None, None] - up
    direct = (distance**2 / cosine.clamp(min=LEAST_COSINE))[:, None, None]
    surfaces = []
    for number, beyond in itertools.product(range(len(SIDES)), BEYOND.values()):
        axis, sign = number // 2, 2 * (number % 2) - 1
        wall = (high[axis] if sign > 0 else -low[axis]) + beyond * extent
        lit = (wall - sign * camera[:, axis]).clamp(min=0.0)[:, None, None]
        away = (wall - sign * xy[:, axis])[:, None, None]
        along = (xy - camera[:, :2])[:, 1 - axis, None, None] + aside
        first = (lit**2 + along**2 + height**2).sqrt().clamp(min=float(up[0]))
        second = (away**2 + aside**2 + up**2).sqrt()
        # Three cosines, and the fall of the light on both parts of the path.
        cosines = depth * up * lit * away
        strength = (width / torch.pi) * cosines / (first**3 * second.square().square())
        extra = first + second - distance[:, None, None]
        surfaces.append(torch.polar(strength * direct, turn / 2 * extra).sum((-1, -2)))
    return torch.stack(surfaces, dim=-1)


def camera_over_target(inputs: EffectInputs) -> Tensor:
    """Return the camera of each pixel in the target's coordinates, height positive, (M, 3)."""
    facts = inputs.facts
    target_from_world = se3.inverse(se3.world_from_plane(facts.normal_world, facts.offset))
    place = (target_from_world @ facts.world_from_tool @ inputs.tool_from_camera)[:, :3, 3]
    return inputs.of_frame(torch.cat([place[:, :2], place[:, 2:].abs()], dim=1))


# The effect.


# Degree over the target of the light of the room. Chosen: what many bounces light is smooth.
_ROOM_DEGREE = 2


class MultipathShape(AreaShape):
    """The area of the target that the camera saw, and what the frames show beside the target.

    Attributes:
        distance_m: Mean distance from which the target was seen.
        surfaces: Large planes n . p = offset of the world that light one another: n, offset, and
            brightness over that of the target's bright parts. Empty: the frames show the target
            alone.
        targets: How many of them are targets; they come first.
        light_half_angle_deg: How far off the optical axis the camera's light reaches.
        amplitude_at_1m: Of the target's bright parts, seen straight on.
        strength: Coefficient of second bounces at which the light between surfaces is computed.
    """

    distance_m: float = 1.0
    surfaces: tuple[tuple[Number, Number, Number, Number, Number], ...] = ()
    targets: int = 0
    light_half_angle_deg: PositiveNumber = 45.0
    amplitude_at_1m: PositiveNumber = 1.0
    strength: PositiveNumber = 1.0

    def around(self) -> Surroundings:
        """Return the surfaces and their brightness."""
        planes = torch.tensor(self.surfaces, dtype=torch.float64)
        return Surroundings(planes[:, :3], planes[:, 3], self.amplitude_at_1m * planes[:, 4])

    def gain(self, coefficient: float) -> float:
        """Return the gain of second bounces, as in `SecondBouncesState`, of their coefficient."""
        return coefficient / (math.pi * self.amplitude_at_1m)


class MultipathEffect(SignalEffect, shape=MultipathShape):
    r"""Light by other ways than the direct one, in three forms that add up.

    .. math:: z' = z \Bigl(1 + \sum_s \rho_s a_s + j \frac{4 \pi f}{c} R
              + \kappa \frac{D_0^2}{d^2} \cos\theta \, e^{j \varphi(d)} \Bigr), \quad
              \Delta d = \frac{c}{4 \pi f} \arg (z' \bar z)

    *Surfaces.* A diffuse surface of reflectivity rho stands at right angles to the target, beside
    the area seen. The light by its patches p, of area A, at the distances r from the camera and q
    from the target's point, is relative to the direct light

    .. math:: a_s = \sum_p \frac{A_p}{\pi} \frac{\cos\alpha_p \cos\beta_p \cos\gamma_p}{r_p^2 q_p^2}
              \frac{d^2}{\cos\theta} e^{j \varphi((r_p + q_p - d) / 2)} .

    A patch is lit at the angle alpha, radiates at beta, and its light arrives at gamma. The direct
    light falls with the distance d and the angle theta. *Room.* What bounced more often lights the
    target evenly, whatever the room looks like. Its error grows as the direct light falls,

    .. math:: R = \frac{d^2}{D_0^2 \cos\theta}
              \sum_{i+j \le 2} (u_{ij} + v_{ij} (d / D_0 - 1)) P_i(x) P_j(y) ,

    with the mean distance D_0 of the recording. *Flange.* What holds the camera sends the light of
    the target back to it. In corners the camera reads centimetres too far (Gudmundsson et al.
    2007).

    Source: Gudmundsson et al. 2007; Corti et al. 2015; Lambert's law.
    """

    name = "multipath"
    summary = "light reflected by a wall, a floor or a table beside the target"
    remedy = "move the target within the room, or cover the floor with something black"
    needs = (FREQUENCY, FIXED_TARGET)
    _of_unseen = (
        *(Coefficient(f"{side}_{place}", "1", 0.5) for side in SIDES for place in BEYOND),
        *(
            Coefficient(f"room_x{i}_y{j}{suffix}", "m", 0.03 / (1 + i + j))
            for suffix in ("", "_distance")
            for i, j in exponents(0, _ROOM_DEGREE)
        ),
        Coefficient("flange", "1", 0.05),
    )

    @classmethod
    def terms(cls, shape: MultipathShape) -> tuple[Coefficient, ...]:
        """Return the reflectivity of the target, or the coefficients of what was not seen."""
        return (Coefficient(SECOND_BOUNCES, "1", 1.0),) if shape.surfaces else cls._of_unseen

    @classmethod
    def for_recording(cls, inputs: EffectInputs) -> Self:
        """Place the surfaces at the edges of the area that the camera saw."""
        distance = float(inputs.radial_distance.mean())
        return cls(MultipathShape.seen(inputs, distance_m=distance))

    @classmethod
    def forms(cls, inputs: EffectInputs) -> tuple[Self, ...]:
        """Return the effect of surfaces that the frames show too, for some cones of light."""
        usual = cls.for_recording(inputs)
        seen = _seen(inputs)
        if not seen:
            return (usual,)
        corner = math.degrees(math.acos(float(ray_directions(inputs.camera)[..., 2].min())))
        cones = [{**seen, "light_half_angle_deg": share * corner} for share in _CONES]
        return usual, *(cls(usual.shape.model_copy(update=each)) for each in cones)

    def with_coefficients(self, coefficients: Tensor) -> Self:
        """Return the effect with coefficients (K,), and the light between surfaces at these."""
        shape, strength = self.shape, float(coefficients[0])
        if shape.surfaces and strength > 0:
            shape = shape.model_copy(update={"strength": strength})
        return type(self)(shape, coefficients)

    def again(self, inputs: EffectInputs, error: ErrorElsewhere) -> Self:
        """Return the effect with the surfaces that frames without these second bounces show."""
        shape = self.shape
        seen = _seen(inputs, error, self) if shape.surfaces else {}
        return type(self)(shape.model_copy(update=seen), self.coefficients)

    @property
    def depends_on_pose(self) -> bool:
        """Whether it changes with the camera's pose by much more than with distances alone."""
        return bool(self.shape.surfaces)

    @property
    def said(self) -> str:
        """What it is in this form, in one line."""
        count = len(self.shape.surfaces) - self.shape.targets
        planes = "a plane" if count == 1 else f"{count} planes"
        return f"second bounces of light by {planes} in view" if count else self.summary

    def on_signal(self, state: FrameState) -> None:
        """Add the light of the other ways to every harmonic."""
        if not bool(self.coefficients.any()):
            return
        inputs, coefficients = inputs_from_state(state), self.coefficients.to(torch.complex128)
        orders = state.orders.tolist()
        added = [_response(inputs, self.shape, order) @ coefficients for order in orders]
        state.signal = state.signal * (1 + torch.stack(added).reshape(state.signal.shape))

    def shares(self, inputs: EffectInputs) -> Tensor:
        """Return each coefficient's light over the direct light, shape (M, K), complex."""
        return inputs.remembered(_response, self.shape, 1)

    def at(self, inputs: EffectInputs, place: Tensor, pose: Tensor) -> Tensor:
        """Return second bounces over direct light at points of one frame, complex (N,).

        Args:
            inputs: Of the recording.
            place: On any of the surfaces, in the camera's axes (N, 3), metres.
            pose: Of the camera in the world (4, 4).
        """
        around, half_angle = self.shape.around(), math.radians(self.shape.light_half_angle_deg)
        gain = self.shape.gain(max(float(self.coefficients[0]), 0.0))
        at = place @ pose[:3, :3].T + pose[:3, 3]
        normal = around.normal[(at @ around.normal.T - around.offset).abs().argmin(1)]
        normal = normal * (normal * (pose[:3, 3] - at)).sum(1, keepdim=True).sign()
        light = CameraLight(pose, half_angle, inputs.known_frequency, gain)
        return bounced(around, light, at, normal)


def _seen(
    inputs: EffectInputs,
    error: ErrorElsewhere | None = None,
    effect: MultipathEffect | None = None,
) -> dict[str, Any]:
    """Return surfaces and amplitude of the shape; empty where the frames show the target alone.

    Args:
        inputs: Of the recording.
        error: Of the camera; None: not known.
        effect: Second bounces that are taken off too; None: not known.
    """
    facts = inputs.facts
    if inputs.amplitude is None or inputs.amplitude_images is None:
        return {}
    exposure = torch.ones_like(facts.offset)
    if facts.integration_time is not None:
        exposure = facts.integration_time / facts.integration_time.mean()
    bright = inputs.amplitude * inputs.radial_distance**2 / inputs.incidence_cosine
    white = inner_range(bright / inputs.of_frame(exposure))[1]
    targets = torch.cat([facts.normal_world, -facts.offset[:, None]], dim=1).unique(dim=0)
    rays = ray_directions(inputs.camera).reshape(-1, 3)
    pixel, poses = sampled(rays), facts.world_from_tool @ inputs.tool_from_camera
    distance = known(inputs, "distance_images").flatten(1)[:, pixel].double()
    if error is not None and effect is not None:
        frame = torch.arange(len(poses)).repeat_interleave(len(pixel))
        own = error(frame, pixel.repeat(len(poses))).reshape(distance.shape)
        second = torch.stack(
            [
                1 + effect.at(inputs, rays[pixel] * one[:, None], pose)
                for one, pose in zip(distance - own.nan_to_num(), poses, strict=True)
            ]
        )
        off = own + inputs.metres_per_radian * second.angle()
        distance = torch.where(off.isnan() | (distance <= 0), distance, distance - off)
    found = surroundings_of(
        distance,
        inputs.amplitude_images.flatten(1)[:, pixel] / (white * exposure[:, None]),
        rays[pixel],
        poses,
        targets,
    )
    if len(found.offset) == len(targets):
        return {}
    planes = torch.cat([found.normal, found.offset[:, None], found.brightness[:, None]], dim=1)
    return {
        "surfaces": tuple(map(tuple, planes.tolist())),
        "targets": len(targets),
        "amplitude_at_1m": white,
    }


def _second_bounces(inputs: EffectInputs, shape: MultipathShape, order: int) -> Tensor:
    """Return second bounces over the direct light, of a white target, shape (M,), complex."""
    facts, around, gain = inputs.facts, shape.around(), shape.gain(shape.strength)
    half_angle, frequency = math.radians(shape.light_half_angle_deg), inputs.known_frequency
    light = torch.zeros_like(inputs.radial_distance, dtype=torch.complex128)
    for number, pose in enumerate(facts.world_from_tool @ inputs.tool_from_camera):
        own, normal = inputs.frame == number, facts.normal_world[number]
        facing = normal * (normal @ pose[:3, 3] + facts.offset[number]).sign()
        camera = CameraLight(pose, half_angle, order * frequency, gain)
        place = inputs.points_world[own]
        light[own] = bounced(around, camera, place, facing.expand_as(place))
    return light.masked_fill(light.isnan(), 0.0) / shape.strength


def _response(inputs: EffectInputs, shape: MultipathShape, order: int) -> Tensor:
    """Return each coefficient's light over the direct light, shape (M, K), complex."""
    turn = order * 4 * torch.pi * inputs.known_frequency / SPEED_OF_LIGHT
    distance, cosine = inputs.radial_distance, inputs.incidence_cosine
    if shape.surfaces:
        return _second_bounces(inputs, shape, order)[:, None]
    far = distance / shape.distance_m
    flange = torch.polar(cosine / far**2, turn * distance)[:, None]
    camera = camera_over_target(inputs)
    parts = [
        light_by_surfaces(inputs.target_xy[k], camera[k], distance[k], cosine[k], shape, turn)
        for k in torch.arange(len(distance)).split(AT_ONCE)
    ]
    light = torch.cat(parts)
    light = light.masked_fill(light.isnan(), 0.0)  # Beside the target.
    # What bounced more often lights the target evenly; its error grows as the direct light falls.
    x, y = shape.scaled(inputs.target_xy)
    strength = far**2 / cosine.clamp(min=LEAST_COSINE)
    smooth = strength[:, None] * side_by_side(products(x, y, 0, _ROOM_DEGREE))
    room = 1j * turn * torch.cat([smooth, (far - 1)[:, None] * smooth], dim=1)
    return torch.cat([light, room, flange], dim=1)


def second_bounces_state(
    effect: CatalogueEffect, frequency: float | None, interval: tuple[float, float] | None = None
) -> SecondBouncesState | None:
    """Return the second bounces of a camera; None if an effect is not that of surfaces seen.

    Args:
        effect: Any, with its coefficients.
        frequency: Hz.
        interval: Of the coefficient of second bounces; None: it is not known.
    """
    shape, value = effect.shape, float(effect.coefficients[0])
    if not (isinstance(shape, MultipathShape) and shape.surfaces and frequency and value > 0):
        return None
    low, high = map(shape.gain, interval or (value, value))
    return SecondBouncesState(
        frequencies_hz=(frequency,),
        gain=shape.gain(value),
        gain_interval=None if interval is None else (low, high),
        light_half_angle_deg=shape.light_half_angle_deg,
    )
