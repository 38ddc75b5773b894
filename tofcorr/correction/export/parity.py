"""Compares an exported corrector with the float64 model."""

import torch
from torch import Tensor

from tofcorr.correction.loaded import Correct
from tofcorr.correction.model import AGREEMENT
from tofcorr.correction.state import CalibrationState
from tofcorr.error_terms.base import EVERYTHING
from tofcorr.errors import ExportError
from tofcorr.geometry.rays import ray_directions


def probe_frames(state: CalibrationState) -> tuple[Tensor, Tensor]:
    """Return frames inside and around the calibrated ranges, with every kind of missing return.

    Returns:
        Depth and amplitude, float32, shape (2, H, W), or (3, H, W) with a frame for flying pixels:
        two walls that share a column. Always the same for one calibration.
    """
    generator = torch.Generator().manual_seed(0)
    shape = (2, state.camera.height, state.camera.width)
    limits = state.model().error.limits(state.domain)
    ends, amplitudes = limits.radial_distance, limits.amplitude or EVERYTHING
    depth, amplitude = (_around(one, shape, generator) for one in (ends, amplitudes))
    if state.scene.second_bounces is not None:
        # Which planes are found in noise depends on the last digit: two walls that meet.
        rays = ray_directions(state.camera)
        near = rays[..., 2] + rays[..., 0].abs()
        depth = (sum(ends) / 2 * near.min() / near).float().repeat(shape[0], 1, 1)
        amplitude = torch.full(shape, min(sum(amplitudes) / 2, 10**6))
    # Cells of 1 % of the pixels each: every kind of missing value, and both ends of the ranges.
    kind = torch.randint(0, 100, shape, generator=generator)
    for k, value in enumerate((torch.nan, 0.0, -1.0, torch.inf, -torch.inf, *ends)):
        depth[kind == k] = value
    for k, value in enumerate((torch.nan, 0.0, torch.inf, *amplitudes), start=50):
        amplitude[kind == k] = value
    if state.scene.flying_pixels is None:
        return depth, amplitude
    share = (torch.arange(shape[2]) > shape[2] // 2).float().repeat(shape[1], 1)
    # Far from the share at which a surface is certain.
    share[:, shape[2] // 2] = (torch.tensor([1, 5, 9]) / 10).repeat(shape[1])[: shape[1]]
    walls = ends[0] + (1 + share) / 3 * (ends[1] - ends[0])
    light = torch.full_like(share, min(sum(amplitudes) / 2, 10**6))
    frames = ((depth, walls), (amplitude, light))
    depth, amplitude = (torch.cat([images, own[None]]) for images, own in frames)
    return depth, amplitude


_OF_SUMS = 100.0
"""Times the tolerance with second bounces: sums over a thousand patches in float32. Chosen:
0.1 mm; 6 um were measured."""


@torch.no_grad()
def require_parity(correct: Correct, state: CalibrationState, tolerance: float = AGREEMENT) -> None:
    """Refuse an export that does not agree with the float64 model on probing frames.

    Raises:
        ExportError: Depths differ by more than `tolerance` metres, beyond 1 m by more than that
            share of them, or pixels in validity or in whether they are NaN.
    """
    frames = probe_frames(state)
    depth, amplitude = (frame.double() for frame in frames)
    corrected, valid = correct(*frames)
    expected, expected_valid = state.corrected(depth, amplitude)
    # Nudging the inputs by some roundings of float32, for the products of variables, changes the
    # validity of a pixel on an edge: it may be valid or not. Neighbours are nudged apart.
    on_edge, edge = torch.zeros_like(expected_valid), 100 * torch.finfo(torch.float32).eps
    sign = 2 * torch.randint(0, 2, depth.shape, generator=torch.Generator().manual_seed(1)) - 1
    up, down = 1 + edge * sign, 1 - edge * sign
    for d, a in ((up, 1.0), (down, 1.0), (1.0, up), (1.0, down)):
        on_edge |= state.corrected(depth * d, amplitude * a)[1] != expected_valid
    lost = corrected.isfinite() != expected.isfinite()
    mistaken = int((lost | ((valid != expected_valid) & ~on_edge)).sum())
    if state.scene.stray_light is not None:
        tolerance *= 10  # It moves a dark pixel by decimetres, of which float32 has six digits.
    # What is missing on both sides does not differ; what is missing on one was counted.
    apart, allowed = (corrected.double() - expected).abs(), tolerance * expected.abs().clamp(min=1)
    if state.scene.second_bounces is not None:
        allowed = _OF_SUMS * allowed
    if state.scene.flying_pixels is not None:
        apart[on_edge] = 0.0  # A surface may be given in place of a mixture, or not.
    if bool((apart > allowed).any()) or mistaken:
        largest = float(apart.nan_to_num(0.0, 0.0).max())
        said = f"by {largest:.1e} m ({tolerance:.0e} allowed), and {mistaken} pixels in validity"
        why = "Are its amplitudes in one unit (`tofcorr inspect`)? Nothing was written."
        raise ExportError(f"The export differs from the float64 model {said}. {why}")


def _around(
    interval: tuple[float, float], shape: tuple[int, ...], generator: torch.Generator
) -> Tensor:
    """Draw values from an interval and a fifth of its width on either side, float32."""
    low, high = (max(min(end, 10**6), -(10**6)) for end in interval)
    share = (7 * torch.rand(shape, generator=generator) - 1) / 5
    return (low + (high - low) * share).clamp(min=AGREEMENT).float()
