"""One frame of the simulator: a camera at the origin before a wall."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.simulation.effects.registry import build_effects
from tofcorr.simulation.hooks import FrameFacts, FrameState
from tofcorr.simulation.options import SensorOptions
from tofcorr.simulation.scene import SceneOptions
from tofcorr.simulation.simulator import SensorPipeline


def seen_wall(
    camera: CameraIntrinsics,
    sensor: dict[str, Any],
    plane: tuple[Tensor, Tensor],
    effects: Sequence[dict[str, Any]] = (),
    conditions: dict[str, float] | None = None,
    **given: Any,
) -> FrameState:
    """Return what a camera sees of a white wall: its normal (3,) and offset ()."""
    known = {"timestamp": 0.0} | (conditions or {})
    eye = torch.eye(4, dtype=torch.float64)
    facts = FrameFacts(
        world_from_tool=eye[None],
        normal_world=plane[0][None],
        offset=plane[1][None],
        **{name: eye.new_tensor([value]) for name, value in known.items()},
    )
    state = FrameState(
        index=0, facts=facts, target="white", world_from_tool=eye, tool_from_camera=eye, **given
    )
    options = SensorOptions.from_mapping(sensor, "test")
    return SensorPipeline(camera, options, SceneOptions(), build_effects(effects)).run(state)
