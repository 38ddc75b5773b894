"""Probes: patterns of effects that the catalogue does not contain.

A probe is never reported as a cause. Where one explains what no effect of the catalogue explains,
the cause is unknown, and the probe describes its pattern.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from tofcorr.geometry.ranges import phase_from_radial_distance
from tofcorr.simulation.effects.inputs import EffectInputs

# Periods of the periodic probe, frames. Chosen: cycles of exposures and modulation frequencies.
_PERIODS = (2, 3, 4, 5)
# Most half waves over the image, in both directions together. Chosen.
_MAP_WAVES = 9
# Prior standard deviation of a probe, metres. Chosen.
_SIZE = 0.01
# Amplitude ratios are clamped here, so that dark pixels do not dominate a probe.
_MOST_BRIGHTER = 20.0


@dataclass(frozen=True)
class Probe:
    """One pattern.

    Attributes:
        name: For programs.
        trace: What it looks like: a clause that follows "It".
        columns: Computes its columns, shape (M, K), metres at one prior standard deviation.
        part_of: Effects of the catalogue that may look like it.
    """

    name: str
    trace: str
    columns: Callable[[EffectInputs], Tensor]
    part_of: tuple[str, ...] = ()


def probes_for(inputs: EffectInputs) -> dict[str, Probe]:
    """Return the probes that a recording allows."""
    found = [
        Probe("frame_period", "repeats every few frames", _frame_period),
        Probe(
            "image_shape",
            "has one shape in every image, finer than the pixel effect",
            _map,
            part_of=("fixed_pattern", "row_column_pattern"),
        ),
    ]
    if len(inputs.facts.timestamp) > 2:
        found.append(Probe("previous_frame", "depends on the previous frame", _previous_frame))
    return {probe.name: probe for probe in found}


def _frame_period(inputs: EffectInputs) -> Tensor:
    number = torch.arange(len(inputs.facts.timestamp), dtype=torch.float64)
    columns = []
    for period in _PERIODS:
        turn = 2 * torch.pi * number / period
        columns.append(torch.cos(turn))
        if period > 2:
            columns.append(torch.sin(turn))
    return inputs.of_frame(_SIZE * torch.stack(columns, dim=-1))


def _map(inputs: EffectInputs) -> Tensor:
    """Return products of cosines over the image, up to nine half waves, shape (M, K).

    Short waves have smaller priors, so that the probe is smooth.
    """
    # Each pixel once, however many frames show it.
    used, number = inputs.pixel.unique(return_inverse=True)
    height, width = inputs.camera.height, inputs.camera.width
    x = torch.remainder(used, width).double() / max(width - 1, 1)
    y = torch.div(used, width, rounding_mode="floor").double() / max(height - 1, 1)
    of_x = [torch.cos(torch.pi * i * x) for i in range(_MAP_WAVES)]
    of_y = [torch.cos(torch.pi * i * y) for i in range(_MAP_WAVES)]
    columns = [
        _SIZE / (1.0 + 0.3 * (i + j)) * of_x[i] * of_y[j]
        for i in range(_MAP_WAVES)
        for j in range(_MAP_WAVES)
        if 0 < i + j <= _MAP_WAVES
    ]
    return torch.stack(columns, dim=-1)[number]


def _previous_frame(inputs: EffectInputs) -> Tensor:
    """Return the change since the previous frame, and the error that its signal would make."""
    before = (inputs.frame - 1).clamp(min=0)
    first = inputs.frame == 0
    assert inputs.distance_images is not None
    distance = inputs.distance_images.flatten(1)[before, inputs.pixel].double()
    seen = (distance > 0) & ~first
    further = torch.where(seen, distance - inputs.radial_distance, 0.0)
    columns = [0.05 * further]
    if inputs.amplitude_images is not None and inputs.modulation_frequency is not None:
        amplitude = inputs.amplitude_images.flatten(1)[before, inputs.pixel].double()
        columns.append(_by_other(inputs, torch.where(seen, amplitude, 0.0), distance))
    return torch.stack(columns, dim=-1)


def _by_other(inputs: EffectInputs, amplitude: Tensor, distance: Tensor) -> Tensor:
    """Return the error by a tenth of another signal added to the pixel's own, (M,), metres."""
    difference = phase_from_radial_distance(distance, inputs.known_frequency) - inputs.phase
    share = (amplitude / inputs.known_amplitude.clamp(min=1e-6)).clamp(max=_MOST_BRIGHTER)
    return 0.1 * inputs.metres_per_radian * share * torch.sin(difference)
