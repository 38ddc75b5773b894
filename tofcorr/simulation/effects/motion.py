"""Motion of camera or target while the four samples are taken."""

import torch
from torch import Tensor

from tofcorr.geometry.rays import phase_from_radial_distance
from tofcorr.simulation.effects.base import (
    FREQUENCY,
    VELOCITY,
    CatalogueEffect,
    EffectInputs,
    inputs_from_state,
    known,
    phase_difference,
    terms_in,
)
from tofcorr.simulation.hooks import FrameState

_NUMBER = torch.arange(4, dtype=torch.float64)[:, None]
# Time between samples, of the first, and half of a read-out.
_TIMES = ("sample_interval_s", "first_sample_s", "half_of_rows_s", "half_of_columns_s")


class MotionEffect(CatalogueEffect):
    r"""Each sample sees the target at another distance.

    .. math:: t_k = \cos \bigl(\varphi + \tfrac{4 \pi f}{c} v (k\, \delta + \epsilon)
              + k \pi / 2 \bigr), \quad k = 0 \ldots 3, \quad
              \epsilon = \epsilon_0 + \epsilon_r r + \epsilon_c c

    for the radial speed v of the target, the time delta from sample to sample and the time epsilon
    of the first one after the pose. Where rows or columns are read one after the other, epsilon
    grows over the image (r and c from -1 to 1). 44 mm RMS at 2 m/s and 125 ms (Drayton et al.
    2013).

    Source: Drayton et al. 2013; Lindner and Kolb 2009.
    """

    name = "motion"
    summary = "camera or target moving while the four samples are taken"
    remedy = "the same poses at rest and in motion, in both directions"
    needs = (VELOCITY, FREQUENCY)
    fixed_terms = terms_in("s", dict.fromkeys(_TIMES, 0.1))

    def shift(self, inputs: EffectInputs, coefficients: Tensor) -> Tensor:
        """Return the error of the phase of four samples as distance, shape (M,), metres."""
        moved = radial_speed(inputs) * _late(inputs, coefficients)
        phase = inputs.phase + phase_from_radial_distance(moved, inputs.known_frequency)
        taps = torch.cos(phase + _NUMBER * torch.pi / 2)
        seen = torch.complex(taps[0] - taps[2], taps[3] - taps[1])
        return inputs.metres_per_radian * phase_difference(seen, inputs.turn)

    def on_signal(self, state: FrameState) -> None:
        """Give each sample its own distance."""
        twist = state.facts.tool_twist
        if twist is None or bool(twist[-1].isnan().any()):
            return
        inputs = inputs_from_state(state)
        delays = radial_speed(inputs) * _late(inputs, self.coefficients)
        delays = delays.reshape(4, *state.radial_distance.shape)
        state.tap_delay = delays if state.tap_delay is None else state.tap_delay + delays


def _late(inputs: EffectInputs, coefficients: Tensor) -> Tensor:
    """Return the times of the four samples after the pose, shape (4, M), s."""
    interval, first, rows, columns = coefficients.unbind(0)
    return _NUMBER * interval + first + rows * inputs.rows + columns * inputs.columns


def radial_speed(inputs: EffectInputs) -> Tensor:
    """Return how fast the distance along each ray grows, shape (M,), m/s."""
    facts, twist = inputs.facts, known(inputs.facts, "tool_twist")
    rotation = facts.world_from_tool[:, :3, :3]
    linear, angular = ((rotation @ part[..., None])[..., 0] for part in twist.split(3, dim=1))
    arm = inputs.points_world - inputs.of_frame(facts.world_from_tool[:, :3, 3])
    # Velocity of the point of the tool frame that coincides with the seen point of the target.
    # The target is at rest.
    velocity = inputs.of_frame(linear) + torch.linalg.cross(inputs.of_frame(angular), arm)
    normal = inputs.of_frame(facts.normal_world)
    return (velocity * normal).sum(-1) / inputs.incidence_cosine
