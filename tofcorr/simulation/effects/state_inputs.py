"""The inputs of an effect, from a frame that is being simulated."""

from typing import Any

import torch

from tofcorr.simulation.effects.inputs import EffectInputs, FrameFacts
from tofcorr.simulation.hooks import FrameState


def inputs_from_state(state: FrameState) -> EffectInputs:
    """Return what an effect may use of a frame that has passed stage geometry.

    Amplitudes are known from stage light on.
    """
    count = state.radial_distance.numel()
    has_light = state.amplitude.numel() == count
    counts = state.amplitude / state.electrons_per_count if has_light else None
    return EffectInputs(
        camera=state.camera,
        modulation_frequency=state.modulation_frequency,
        tool_from_camera=state.tool_from_camera,
        facts=facts_from_state(state),
        frame=torch.zeros(count, dtype=torch.int64),
        pixel=torch.arange(count),
        rays=state.ray_directions.reshape(-1, 3),
        radial_distance=state.radial_distance.reshape(-1),
        incidence_cosine=state.incidence_cosine.reshape(-1),
        points_world=state.points_world.reshape(-1, 3),
        target_xy=state.target_xy.reshape(-1, 2),
        amplitude=None if counts is None else counts.reshape(-1),
        amplitude_images=None if counts is None else counts.nan_to_num(0.0)[None],
        distance_images=state.radial_distance.nan_to_num(0.0)[None],
    )


def facts_from_state(state: FrameState) -> FrameFacts:
    """Return what is recorded of one simulated frame, F = 1."""
    conditions: dict[str, Any] = {
        name: None if value is None else torch.tensor([value], dtype=torch.float64)
        for name, value in state.conditions.by_name().items()
    }
    return FrameFacts(
        world_from_tool=state.world_from_tool_recorded[None],
        normal_world=state.normal_world_recorded[None],
        offset=state.offset_recorded.reshape(1),
        tool_twist=None if state.tool_twist is None else state.tool_twist[None],
        approach=None if state.approach is None else state.approach[None],
        **conditions,
    )
