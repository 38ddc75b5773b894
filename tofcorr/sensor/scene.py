"""A rendered scene as a sensor sees it: distances, surfaces, light, and what effects add."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from functools import cache
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from tofcorr.conditions import condition
from tofcorr.correction.model import CameraGeometry
from tofcorr.error_terms.condition_terms import Condition, in_si_units
from tofcorr.errors import ConfigError, FrameError
from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.sensor.sensor_file import SensorFile
from tofcorr.simulation.effects.base import (
    AMPLITUDE,
    FREQUENCY,
    CatalogueEffect,
    EffectInputs,
    FrameEffect,
)
from tofcorr.simulation.effects.registry import build_effects
from tofcorr.simulation.effects.surface import LEAST_COSINE
from tofcorr.simulation.hooks import FrameFacts

# Conditions count up to this share of their range beyond it (no unit). Derived: a parabola that
# errs by 1 at most within a range errs by 2 an eighth of it further, by 7 half of it further.
_BEYOND = 0.125


@dataclass(frozen=True)
class SceneFrames:
    """B frames of any scene; every tensor is of one dtype.

    Attributes:
        rays: Unit viewing rays, shape (H, W, 3).
        distance: Distances along the rays, shape (B, H, W), metres; 1 where there is none.
        amplitude: The camera's units, shape (B, H, W); zero where there is no surface.
        seen: Where there is a surface, bool, shape (B, H, W).
        conditions: Conditions in SI units by name, each (B,); only those that are known.
        surface: Returns the true surfaces, as `surfaces` does.
    """

    rays: Tensor
    distance: Tensor
    amplitude: Tensor
    seen: Tensor
    conditions: Mapping[str, Tensor]
    surface: Callable[[], tuple[Tensor, Tensor]]

    def inputs(self, camera: CameraIntrinsics, modulation_frequency: float | None) -> EffectInputs:
        """Return what effects may use of all pixels, M = B H W of them.

        Poses and planes, which images lack, stand for a camera at the origin; the target's
        coordinates are those of the camera.
        """
        count, pixels = len(self.distance), self.rays[..., 0].numel()
        rays = self.rays.expand(count, *self.rays.shape).reshape(-1, 3)
        distance, (cosine, normals) = self.distance.reshape(-1), self.surface()
        points = distance[:, None] * rays
        return EffectInputs(
            camera=camera,
            modulation_frequency=modulation_frequency,
            tool_from_camera=torch.eye(4, dtype=torch.float64),
            facts=_facts(self.conditions, count, distance),
            frame=torch.arange(count).repeat_interleave(pixels),
            pixel=torch.arange(pixels).repeat(count),
            rays=rays,
            radial_distance=distance,
            incidence_cosine=cosine.reshape(-1),
            points_world=points,
            target_xy=points[:, :2],
            amplitude=self.amplitude.reshape(-1),
            amplitude_images=self.amplitude,
            distance_images=torch.where(self.seen, self.distance, 0.0),
            light=self.amplitude.reshape(-1),
            normals_camera=normals.reshape(-1, 3),
        )


class Eye(CameraGeometry):
    """Geometry and light of a sensor.

    Args:
        sensor: The camera.
    """

    advice = "Render with the sensor's camera."

    def __init__(self, sensor: SensorFile) -> None:
        camera = sensor.intrinsics()
        if min(camera.width, camera.height) < 2:
            raise ConfigError("camera: a sensor compares neighbours, and needs 2 x 2 at least.")
        super().__init__(camera, sensor.depth_kind)
        self.light = sensor.light

    def forward(
        self,
        true_depth: Tensor,
        amplitude: Tensor | None,
        reflectivity: Tensor | None,
        conditions: Mapping[str, Tensor],
        *,
        needs_amplitude: bool,
    ) -> SceneFrames:
        """Return the frames of a scene, B of them, in the dtype of the rays.

        Args:
            true_depth: Of the camera's kind, shape (..., H, W), metres.
            amplitude: The camera's units, the same shape; None: from the reflectivity.
            reflectivity: 0 to 1, the same shape; None: the sensor's usual one.
            conditions: In SI units by name, each (B,).
            needs_amplitude: Whether what is computed depends on it.

        Raises:
            FrameError: The frames are of another size or dtype, or an amplitude is needed and
                nothing says it.
        """
        self.check(true_depth=true_depth, amplitude=amplitude, reflectivity=reflectivity)
        if amplitude is self.light is None and (needs_amplitude or reflectivity is not None):
            said = "amplitude: the measurement depends on it, and the sensor's file has no section"
            raise FrameError(f"{said} 'light'; pass amplitudes in the camera's units.")
        rays = self.ray_directions
        depth = true_depth.reshape(-1, *true_depth.shape[-2:]).to(rays)
        lit, shares = (
            None if image is None else image.reshape(depth.shape).to(rays)
            for image in (amplitude, reflectivity)
        )
        seen = torch.isfinite(depth) & (depth > 0)
        distance = torch.where(seen, depth * self.radial_of_depth, 1.0)
        surface = cache(lambda: surfaces(distance, seen, rays))
        if lit is None and self.light is not None:
            shares = self.light.usual_reflectivity if shares is None else shares
            # Lambertian surfaces lit from beside the camera.
            lit = self.light.amplitude_at_1m * surface()[0] * shares / distance.square()
            lit = lit * rays[..., 2] ** self.light.vignetting_exponent
        amplitude = torch.zeros_like(depth)
        if lit is not None:
            amplitude = torch.where(seen & torch.isfinite(lit), lit, 0.0)
        return SceneFrames(rays, distance, amplitude, seen, conditions, surface)


def surfaces(distance: Tensor, seen: Tensor, rays: Tensor) -> tuple[Tensor, Tensor]:
    """Return the planes a X + b Y + c Z = 1 through each pixel and its neighbours.

    On a plane 1/Z is linear in x = X/Z and y = Y/Z. Its slope is taken to the neighbour, on each
    axis, towards which 1/Z changes less: never across the outline of an object. On a plane the
    result is exact; without a neighbour the surface is taken as parallel to the image.

    Args:
        distance: Radial distance, shape (B, H, W), metres, finite; both sides at least 2 pixels.
        seen: Where there is a surface, shape (B, H, W), bool.
        rays: Unit rays, shape (H, W, 3).

    Returns:
        The cosine between the way back along the ray and the normal, shape (B, H, W), and unit
        normals on the camera's side, shape (B, H, W, 3).
    """
    slant = rays[..., 2]
    inverse = 1 / (distance * slant)
    x, y = ((rays[..., axis] / slant).expand_as(inverse) for axis in (0, 1))
    steps, known = [], True
    for axis, sides in ((1, (0, 0, 1, 1)), (2, (1, 1, 0, 0))):
        count = inverse.shape[axis]
        change = torch.stack([inverse, x, y]).diff(dim=axis + 1)
        both = pad(seen.narrow(axis, 0, count - 1) & seen.narrow(axis, 1, count - 1), sides)
        # The change to each pixel from the one before, and from it to the one after.
        change = pad(change, sides, mode="replicate")
        size = torch.where(both, change[0].detach().abs(), torch.inf)
        backward = size.narrow(axis, 0, count) <= size.narrow(axis, 1, count)
        before, after = (change.narrow(axis + 1, start, count) for start in (0, 1))
        steps.append(torch.where(backward, before, after))
        known = known & (both.narrow(axis, 0, count) | both.narrow(axis, 1, count))
    (down, down_x, down_y), (right, right_x, right_y) = steps
    scale = known / (right_x * down_y - right_y * down_x)
    a = scale * (right * down_y - right_y * down)
    b = scale * (right_x * down - right * down_x)
    normal = torch.stack([a, b, inverse - a * x - b * y], dim=-1)
    length = normal.norm(dim=-1)
    cosine = (1 / (distance * length)).clamp(LEAST_COSINE, 1.0)
    return cosine, -normal / length[..., None]


def conditions_of(
    given: Mapping[str, Condition],
    leading: Sequence[int],
    device: torch.device,
    ranges: Mapping[str, Sequence[float]],
) -> dict[str, Tensor]:
    """Return what is known of B frames, by attribute, in SI units, each of shape (B,), float64.

    Conditions are held to the ranges that the sensor was measured in, an eighth of them wider.
    Effects of temperature or exposure are polynomials: far beyond their range they can be
    centimetres off. A time is no such condition: effects of it settle.

    Args:
        given: By column of `frames.csv`.
        leading: The leading shape (...) of the depth (..., H, W).
        device: Of the result.
        ranges: Lowest and highest value first, by attribute.

    Raises:
        FrameError: There is no such condition, or it has neither one value nor one a frame.
    """
    known = in_si_units(given, leading, torch.float64, device)
    for name, number in known.items():
        if name in ranges and name != "timestamp":
            low, high = ranges[name][:2]
            margin = _BEYOND * (high - low)
            known[name] = number.clamp(low - margin, high + margin)
    return {name: number.expand(tuple(leading)).reshape(-1) for name, number in known.items()}


def _facts(conditions: Mapping[str, Tensor], count: int, like: Tensor) -> FrameFacts:
    """Return the conditions of frames; poses and planes, which images lack, stand in front."""
    eye = torch.eye(4, dtype=like.dtype, device=like.device)
    known = {name: values.to(like.dtype) for name, values in conditions.items()}
    return FrameFacts(
        world_from_tool=eye.expand(count, 4, 4),
        normal_world=-eye[2, :3].expand(count, 3),
        offset=like.new_ones(count),
        **{"timestamp": like.new_zeros(count)} | known,
    )


class Group(Enum):
    """Stages of the simulator in groups, in their order; and what delays whole frames."""

    FRAME = ("",)  # At no stage. Python 3.11.2 loses an empty tuple.
    GEOMETRY = ("pose", "geometry")
    DELAY = ("delay",)
    SIGNAL = ("signal", "taps", "readout")


def _group_of(effect: CatalogueEffect) -> Group:
    """Return the last group of stages at which an effect acts; that of whole frames by itself."""
    stages = [(group, f"on_{stage}") for group in Group for stage in group.value]
    acts = [group for group, hook in stages if hasattr(effect, hook)]
    return Group.FRAME if isinstance(effect, FrameEffect) else [Group.DELAY, *acts][-1]


class ImageEffects(nn.Module):
    """The effects of a sensor that depth images can show.

    There are three groups: geometry (the lens), delays, and what mixes signals. The shifts of a
    group add up.

    Args:
        camera: The camera intrinsics.
        entries: As in a simulator's YAML.
        modulation_frequency: Hz; None if unknown.

    Attributes:
        left_out: Effects that no depth image can show, and why, a sentence each.
        needs_amplitude: Whether an effect reads the amplitude.
        reads_light: Whether an effect reads the light of clipped pixels.

    Raises:
        ConfigError: An effect is unknown, or a parameter is wrong.
    """

    def __init__(
        self,
        camera: CameraIntrinsics,
        entries: Sequence[Mapping[str, Any]],
        modulation_frequency: float | None,
    ) -> None:
        super().__init__()
        self._camera, self._frequency = camera, modulation_frequency
        self.left_out: list[str] = []
        self._kept_as_given: list[Mapping[str, Any]] = []
        self._effects: list[CatalogueEffect] = []
        self.coefficients = nn.ParameterList()
        for entry, effect in zip(entries, build_effects(entries), strict=True):
            reasons = [need.beyond_image for need in effect.needs if need.beyond_image]
            if modulation_frequency is None and FREQUENCY in effect.needs:
                reasons.append("the sensor states no modulation_frequency_hz")
            if reasons:
                self.left_out.append(f"{effect.name}: {reasons[0]}.")
                self._kept_as_given.append(entry)
            else:
                self._effects.append(effect)
                self.coefficients.append(nn.Parameter(effect.coefficients.clone()))
        self.needs_amplitude = any(AMPLITUDE in effect.needs for effect in self._effects)
        self.reads_light = any(effect.reads_light for effect in self._effects)

    def usable(
        self, known: Mapping[str, Tensor]
    ) -> tuple[list[tuple[CatalogueEffect, Tensor]], list[str]]:
        """Return the effects whose conditions are known, and a sentence about each other one."""
        usable, missing = [], []
        for effect, coefficients in zip(self._effects, self.coefficients, strict=True):
            needed = [need.condition for need in effect.needs if need.condition]
            columns = [condition(name).column for name in needed if name not in known]
            if columns:
                missing.append(f"{effect.name}: {', '.join(columns)} was not given.")
            else:
                usable.append((effect, coefficients))
        return usable, missing

    def frame_shift(self, known: Mapping[str, Tensor], count: int, like: Tensor) -> Tensor:
        """Return the shift that effects of whole frames cause, shape (B,), metres, float64.

        The order of the frames is that of the recording: a warm-up depends on those before.

        Args:
            known: Conditions by name, each (B,).
            count: Number of frames, B.
            like: Any tensor of the device.
        """
        total = like.new_zeros(count, dtype=torch.float64)
        facts = _facts(known, count, total)
        with total.device:
            for effect, coefficients in self.usable(known)[0]:
                if isinstance(effect, FrameEffect):
                    total = total + effect.shifts(facts, coefficients.to(total))
        return total

    def shift(self, group: Group, frames: SceneFrames) -> Tensor:
        """Return the change of the measured distance by one group, metres.

        Shape (B, H, W); a single zero, shape (1, 1, 1), if the group has no effect.

        Args:
            group: Which effects.
            frames: The frames, at the distance that the effects see.
        """
        usable, distance = self.usable(frames.conditions)[0], frames.distance
        chosen = [(effect, own) for effect, own in usable if _group_of(effect) == group]
        if not chosen:
            return distance.new_zeros(1, 1, 1)
        with distance.device:
            inputs = frames.inputs(self._camera, self._frequency)
            first, *others = (effect.shift(inputs, own.to(distance)) for effect, own in chosen)
        return sum(others, first).reshape(distance.shape).to(distance.dtype)

    def to_mappings(self) -> tuple[Mapping[str, Any], ...]:
        """Return the entries of a simulator's YAML, with the coefficients of now."""
        now = zip(self._effects, self.coefficients, strict=True)
        found = (each.with_coefficients(own.detach().cpu()).to_mapping() for each, own in now)
        return (*found, *self._kept_as_given)

    def description(self) -> list[Any]:
        """Return names and shapes of the effects, and the entries that no image can show."""
        shapes = [[effect.name, effect.shape.to_mapping()] for effect in self._effects]
        return [*shapes, *self._kept_as_given]
