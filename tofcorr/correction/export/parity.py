"""Compares an exported corrector with the float64 model."""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from tofcorr.correction.limits import Limits
from tofcorr.correction.reference import corrected_by_model
from tofcorr.correction.state import CalibrationState
from tofcorr.errors import ExportError

Correct = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]

TOLERANCE = 1e-6
"""Largest difference allowed, metres: float32 resolves 1e-7 m at one metre."""

# Pixels this close to an edge of the validity range, relative, may be valid or not: rounding to
# float32 decides. A hundred times the resolution of float32, for the products of variables.
_EDGE = 1e-5


class Parity(NamedTuple):
    """How far an export is from the model.

    Attributes:
        largest: Largest difference of corrected depths, metres.
        mistaken: Number of pixels that differ in validity, or in whether they are NaN.
        pixels: Pixels compared.
    """

    largest: float
    mistaken: int
    pixels: int


def probe_frames(state: CalibrationState) -> tuple[Tensor, Tensor]:
    """Return frames inside and around the calibrated ranges, with every kind of missing return.

    Returns:
        Depth and amplitude, float32, shape (2, H, W); always the same for one calibration.
    """
    generator = torch.Generator().manual_seed(0)
    shape = (2, state.camera.height, state.camera.width)
    limits = Limits.of(state, state.model().error)
    depth = _around(limits.radial_distance, shape, generator)
    amplitude = _around(limits.amplitude, shape, generator)
    # Cells of 1 % of the pixels each: every kind of missing value, and both ends of the ranges.
    kind = torch.randint(0, 100, shape, generator=generator)
    ends = limits.radial_distance
    for k, value in enumerate((torch.nan, 0.0, -1.0, torch.inf, -torch.inf, *ends)):
        depth[kind == k] = value
    for k, value in enumerate((torch.nan, 0.0, torch.inf, *limits.amplitude), start=50):
        amplitude[kind == k] = value
    return depth, amplitude


def measure_parity(correct: Correct, state: CalibrationState) -> Parity:
    """Compare an exported corrector with the float64 model on probing frames."""
    depth, amplitude = probe_frames(state)
    corrected, valid = correct(depth, amplitude)
    expected, expected_valid = corrected_by_model(state, depth, amplitude)
    apart = (corrected.double() - expected).abs()
    both = corrected.isfinite() & expected.isfinite()
    lost = corrected.isfinite() != expected.isfinite()
    wrong = lost | ((valid != expected_valid) & ~_on_edge(state, depth, amplitude))
    largest = float(apart[both].max()) if bool(both.any()) else 0.0
    return Parity(largest, int(wrong.sum()), depth.numel())


def require_parity(correct: Correct, state: CalibrationState, tolerance: float = TOLERANCE) -> None:
    """Refuse an export that does not agree with the float64 model.

    Raises:
        ExportError: Depths differ by more than `tolerance` metres, or validity differs.
    """
    parity = measure_parity(correct, state)
    if parity.largest > tolerance or parity.mistaken:
        raise ExportError(
            f"The exported corrector differs from the float64 model by {parity.largest:.1e} m "
            f"({tolerance:.0e} m allowed) and in the validity of {parity.mistaken} of "
            f"{parity.pixels} pixels; nothing was written."
        )


def _around(
    interval: tuple[float, float], shape: tuple[int, ...], generator: torch.Generator
) -> Tensor:
    """Draw values from an interval and a fifth of its width on either side, float32."""
    low, high = (max(min(end, 1e6), -1e6) for end in interval)
    width = high - low
    values = low - 0.2 * width + 1.4 * width * torch.rand(shape, generator=generator)
    return values.clamp(min=1e-6).float()


def _on_edge(state: CalibrationState, depth: Tensor, amplitude: Tensor) -> Tensor:
    """Return where nudging the inputs by a rounding error changes the validity."""
    _, inside = corrected_by_model(state, depth.double(), amplitude.double())
    changed = torch.zeros_like(inside)
    for d, a in ((1 + _EDGE, 1.0), (1 - _EDGE, 1.0), (1.0, 1 + _EDGE), (1.0, 1 - _EDGE)):
        _, nudged = corrected_by_model(state, depth.double() * d, amplitude.double() * a)
        changed |= nudged != inside
    return changed
