"""Frames of a scene as a sensor sees them: true distances, light, and inputs of the effects."""

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property

import torch
from torch import Tensor

from tofcorr.geometry.intrinsics import CameraIntrinsics
from tofcorr.sensor.surface import incidence_cosine_of, normals_of
from tofcorr.simulation.effects.inputs import EffectInputs, FrameFacts


@dataclass(frozen=True, kw_only=True)
class SceneFrames:
    """B frames of any scene; every tensor is of one dtype.

    Attributes:
        camera: Intrinsics.
        modulation_frequency: Hz; None if unknown.
        rays: Unit viewing rays, shape (H, W, 3).
        distance: True distances along the rays, shape (B, H, W), metres; 1 where there is none.
        amplitude: The camera's units, shape (B, H, W); zero where there is no surface.
        seen: Where there is a surface, bool, shape (B, H, W).
        conditions: Conditions in SI units by name, each (B,); only those that are known.
        true: The frames at their true distances, which have the surfaces; None: these.
    """

    camera: CameraIntrinsics
    modulation_frequency: float | None
    rays: Tensor
    distance: Tensor
    amplitude: Tensor
    seen: Tensor
    conditions: Mapping[str, Tensor]
    true: "SceneFrames | None" = None

    @cached_property
    def normals(self) -> Tensor:
        """Unit normals of the true surfaces, (B, H, W, 3); towards the camera where unknown."""
        if self.true is not None:
            return self.true.normals
        return normals_of(self.distance, self.seen, self.rays)

    def moved(self, error: Tensor) -> "SceneFrames":
        """Return the same surfaces, seen at distances longer by an error (B, H, W), metres."""
        return replace(self, distance=self.distance + error, true=self.true or self)

    def with_amplitude(self, amplitude: Tensor) -> "SceneFrames":
        """Return the same frames in another light, shape (B, H, W)."""
        return replace(self, amplitude=amplitude)

    @cached_property
    def effect_inputs(self) -> EffectInputs:
        """What effects may use of whole frames, M = B H W, float64."""
        count, pixels = len(self.distance), self.rays[..., 0].numel()
        device = self.distance.device
        rays, normals = self.rays.double(), self.normals.double()
        distance, amplitude = self.distance.double(), self.amplitude.double()
        points = distance[..., None] * rays
        return EffectInputs(
            camera=self.camera,
            modulation_frequency=self.modulation_frequency,
            tool_from_camera=torch.eye(4, dtype=torch.float64, device=device),
            facts=facts_of(self.conditions, count, device),
            frame=torch.arange(count, device=device).repeat_interleave(pixels),
            pixel=torch.arange(pixels, device=device).repeat(count),
            rays=rays.expand(count, *rays.shape).reshape(-1, 3),
            radial_distance=distance.reshape(-1),
            incidence_cosine=incidence_cosine_of(normals, rays).reshape(-1),
            points_world=points.reshape(-1, 3),
            target_xy=points[..., :2].reshape(-1, 2),
            amplitude=amplitude.reshape(-1),
            amplitude_images=amplitude,
            distance_images=torch.where(self.seen, distance, 0.0),
            light=amplitude.reshape(-1),
            normals_camera=normals.reshape(-1, 3),
        )


def facts_of(conditions: Mapping[str, Tensor], count: int, device: torch.device) -> FrameFacts:
    """Return the conditions of frames; poses and planes, which images lack, stand in front."""
    eye = torch.eye(4, dtype=torch.float64, device=device)
    normal = torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64, device=device)
    known = {
        each.name: conditions[each.name].double()
        for each in fields(FrameFacts)
        if each.name in conditions
    }
    known.setdefault("timestamp", torch.zeros(count, dtype=torch.float64, device=device))
    return FrameFacts(
        world_from_tool=eye.expand(count, 4, 4),
        normal_world=normal.expand(count, 3),
        offset=torch.ones(count, dtype=torch.float64, device=device),
        **known,
    )
