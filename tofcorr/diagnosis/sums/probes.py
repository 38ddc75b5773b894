"""Marks of effects that the catalogue does not hold.

A probe is no cause and gets no name among the effects. Where one explains what every effect of the
catalogue does not, the cause is unknown, and the probe says what its trace looks like.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from tofcorr.geometry.ranges import phase_from_radial_distance
from tofcorr.simulation.effects.inputs import EffectInputs

_PERIODS = (2, 3, 4, 5)
_MAP_WAVES = 9
# Columns are scaled to about this, metres, the size that a probe may plausibly have.
_SIZE = 0.01


@dataclass(frozen=True)
class Probe:
    """One mark.

    Attributes:
        name: For programs.
        trace: For people, to go on after "What remains".
        columns: Makes its columns, shape (M, K), metres at the size of a strong effect.
    """

    name: str
    trace: str
    columns: Callable[[EffectInputs], Tensor]


def probes_for(inputs: EffectInputs) -> dict[str, Probe]:
    """Return the probes that a recording allows."""
    found = [
        Probe("frame_period", "repeats every few frames", _frame_period),
        Probe("image_shape", "keeps one shape in the image, too local or fine for pixel", _map),
    ]
    if len(inputs.facts.timestamp) > 2:
        found.append(Probe("previous_frame", "follows the frame before", _previous_frame))
    if inputs.amplitude_images is not None and inputs.modulation_frequency is not None:
        found.append(Probe("mirrored_image", "follows the image mirrored at its centre", _mirrored))
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
    """Return cosines over the image up to nine half waves each way, shape (M, K).

    Short waves get smaller priors, so that the probe is smooth.
    """
    x, y = (inputs.columns + 1) / 2, (inputs.rows + 1) / 2
    of_x = [torch.cos(torch.pi * i * x) for i in range(_MAP_WAVES)]
    of_y = [torch.cos(torch.pi * i * y) for i in range(_MAP_WAVES)]
    columns = [
        _SIZE / (1.0 + 0.3 * (i + j)) * of_x[i] * of_y[j]
        for i in range(_MAP_WAVES)
        for j in range(_MAP_WAVES)
        if 0 < i + j <= _MAP_WAVES
    ]
    return torch.stack(columns, dim=-1)


def _previous_frame(inputs: EffectInputs) -> Tensor:
    """Return how the distance, and the signal if known, of the frame before differs."""
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


def _mirrored(inputs: EffectInputs) -> Tensor:
    """Return what a weak image of the scene, mirrored at the image's centre, adds."""
    assert inputs.amplitude_images is not None
    assert inputs.distance_images is not None
    last = inputs.camera.height * inputs.camera.width - 1
    columns = []
    width, height = inputs.camera.width, inputs.camera.height
    row, column = inputs.pixel // width, inputs.pixel % width
    for other in (
        last - inputs.pixel,
        row * width + (width - 1 - column),
        (height - 1 - row) * width + column,
    ):
        amplitude = inputs.amplitude_images.flatten(1)[inputs.frame, other].double()
        distance = inputs.distance_images.flatten(1)[inputs.frame, other].double()
        columns.append(_by_other(inputs, amplitude, distance))
        share = amplitude / inputs.known_amplitude.clamp(min=1e-6)
        columns.append(_SIZE * share.clamp(max=20.0) / 3)
    return torch.stack(columns, dim=-1)


def _by_other(inputs: EffectInputs, amplitude: Tensor, distance: Tensor) -> Tensor:
    """Return the error of a tenth of another signal added to the pixel's own, shape (M,)."""
    difference = phase_from_radial_distance(distance, inputs.known_frequency) - inputs.phase
    share = (amplitude / inputs.known_amplitude.clamp(min=1e-6)).clamp(max=20.0)
    return 0.1 * inputs.metres_per_radian * share * torch.sin(difference)
