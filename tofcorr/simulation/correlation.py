"""The correlation function of a modulated signal that is not quite sinusoidal.

Light source and pixel are switched on and off, so their correlation has harmonics. Four samples a
quarter period apart cannot separate the odd orders from the fundamental (they alias onto it). The
result is the circular error, with four periods in the unambiguous range. The even orders cancel in
the differences of opposite samples.
"""

import math
from collections.abc import Sequence
from typing import Annotated

import torch
from pydantic import Field
from torch import Tensor

from tofcorr.geometry.ranges import phase_from_radial_distance
from tofcorr.options import Options
from tofcorr.simulation.numbers import Number

_HIGHEST_ORDER = 1000
"""Highest overtone. Chosen: no light source of a camera follows one beyond the twentieth; an
integer without limit fits into no float."""


class Harmonic(Options):
    """One overtone of the correlation function.

    Attributes:
        order: Multiple of the modulation frequency, 2 to 1000.
        share: Its amplitude, relative to that of the fundamental.
        phase_deg: Its phase at distance zero.
    """

    order: Annotated[int, Field(ge=2, le=_HIGHEST_ORDER)]
    share: Number
    phase_deg: Number = 0.0


def harmonic_tensors(harmonics: Sequence[Harmonic]) -> tuple[Tensor, Tensor]:
    """Return orders (M,) float64 and relative phasors (M,) complex128, the fundamental first."""
    orders = [1.0, *(float(harmonic.order) for harmonic in harmonics)]
    shares = [1.0, *(harmonic.share for harmonic in harmonics)]
    phases = [0.0, *(math.radians(harmonic.phase_deg) for harmonic in harmonics)]
    angle = torch.tensor(phases, dtype=torch.float64)
    phasors = torch.tensor(shares, dtype=torch.float64) * torch.exp(1j * angle)
    return torch.tensor(orders, dtype=torch.float64), phasors


def signal_phasors(
    orders: Tensor,
    relative: Tensor,
    amplitude: Tensor,
    optical_distance: Tensor,
    modulation_frequency: float,
) -> Tensor:
    """Return the phasor of each harmonic in each pixel.

    Args:
        orders: Shape (M,).
        relative: Phasors relative to that of the fundamental, shape (M,), complex.
        amplitude: Of the fundamental, shape (H, W).
        optical_distance: Radial distance and delays, shape (H, W), metres.
        modulation_frequency: Hz.

    Returns:
        amplitude relative_m exp(1j m phase), shape (M, H, W), complex128.
    """
    phase = phase_from_radial_distance(optical_distance, modulation_frequency)
    turned = torch.exp(1j * (orders[:, None, None] * phase))
    return relative[:, None, None] * amplitude * turned


def correlation_samples(
    orders: Tensor, signal: Tensor, background: Tensor, tap_phasor: Tensor | None = None
) -> Tensor:
    """Sample the correlation function at quarters of the period.

    Args:
        orders: Shape (M,).
        signal: Phasors, shape (M, H, W), complex128.
        background: Shape (H, W).
        tap_phasor: Factor on each harmonic at each tap, shape (4, M, H, W); None: 1.

    Returns:
        A_k = background + Re sum_m signal_m exp(1j m k pi / 2), shape (4, H, W).
    """
    quarters = torch.arange(4, dtype=torch.float64)[:, None] * (math.pi / 2)
    shift = torch.exp(1j * quarters * orders)
    if tap_phasor is None:
        swing = torch.einsum("km,mhw->khw", shift, signal)
    else:
        swing = torch.einsum("km,kmhw,mhw->khw", shift, tap_phasor, signal)
    return background + swing.real
