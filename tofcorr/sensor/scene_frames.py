"""Frames of a scene as a sensor sees them: true distances, light, and inputs of the effects."""

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property

import torch
from torch import Tensor

from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.sensor.surface import Surface, SurfaceFinder
from tofcorr.simulation.effects.inputs import FrameFacts


@dataclass(frozen=True, kw_only=True)
class SceneFrames:
    """B frames of any scene; every tensor is of one dtype.

    Attributes:
        camera: Intrinsics.
        modulation_frequency: Hz; None if unknown.
        rays: Unit viewing rays, shape (H, W, 3).
        finder: Finds the surfaces.
        distance: True distances along the rays, shape (B, H, W), metres; 1 where there is none.
        amplitude: The camera's units, shape (B, H, W); zero where there is no surface.
        seen: Where there is a surface, bool, shape (B, H, W).
        conditions: Conditions in SI units by name, each (B,); only those that are known.
        true: The frames at their true distances, which have the surfaces; None: these.
    """

    camera: CameraIntrinsics
    modulation_frequency: float | None
    rays: Tensor
    finder: SurfaceFinder
    distance: Tensor
    amplitude: Tensor
    seen: Tensor
    conditions: Mapping[str, Tensor]
    true: "SceneFrames | None" = None

    @cached_property
    def surface(self) -> Surface:
        """The true surfaces."""
        if self.true is not None:
            return self.true.surface
        return self.finder(self.distance, self.seen)

    def moved(self, error: Tensor) -> "SceneFrames":
        """Return the same surfaces, seen at distances longer by an error (B, H, W), metres."""
        return replace(self, distance=self.distance + error, true=self.true or self)

    def with_amplitude(self, amplitude: Tensor) -> "SceneFrames":
        """Return the same frames in another light, shape (B, H, W)."""
        return replace(self, amplitude=amplitude)


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
