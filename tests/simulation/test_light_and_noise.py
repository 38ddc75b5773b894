"""How light falls off, and how much a distance scatters for it."""

import math
from typing import Any

import pytest
import torch
from cameras import camera
from seen_wall import seen_wall
from torch import Generator

from tofcorr.geometry.rays import SPEED_OF_LIGHT, ray_directions
from tofcorr.simulation.hooks import FrameState
from tofcorr.simulation.signal import ReadoutOptions, read_out

CAMERA = camera((40, 30), (60.0, 60.0), (19.5, 14.5))


def measure(
    distance: float,
    tilt: float = 0.0,
    generator: Generator | None = None,
    integration_time: float = math.nan,
    **sensor: Any,
) -> FrameState:
    """Return what a camera sees of a white wall at a distance, tilted about its x axis."""
    normal = torch.tensor([0.0, math.sin(tilt), -math.cos(tilt)], dtype=torch.float64)
    plane = normal, torch.tensor(distance * math.cos(tilt), dtype=torch.float64)
    times = {"integration_time": integration_time}
    return seen_wall(CAMERA, sensor, plane, conditions=times, generator=generator)


def test_a_tilted_wall_is_met_on_its_plane_lit_by_the_cosine_and_measured_exactly() -> None:
    tilt = 0.5
    state = measure(1.2, tilt)
    expected = -(ray_directions(CAMERA) @ state.normal_world)
    torch.testing.assert_close(state.incidence_cosine, expected)
    height = state.points_world @ state.normal_world + state.offset
    assert height.abs().max() < 1e-12
    full = 300_000.0 * 0.5 / 40.0 * ray_directions(CAMERA)[..., 2] ** 4 * 0.8
    lit = full * expected / state.radial_distance**2
    torch.testing.assert_close(state.measured_amplitude, lit)
    assert (state.measured_distance - state.radial_distance).abs().max() < 1e-9


def test_integration_time_scales_light() -> None:
    base = measure(1.0, integration_time=500e-6).measured_amplitude
    longer = measure(1.0, integration_time=1500e-6).measured_amplitude
    torch.testing.assert_close(longer, 3 * base)


@pytest.mark.parametrize("ambient", [0.0, 2000.0])
def test_distance_scatters_by_the_four_tap_formula(ambient: float, generator: Generator) -> None:
    frequency, amplitude, read_noise = 20.0e6, 8000.0, 150.0
    background = 20_000.0 + ambient
    quarters = torch.arange(4, dtype=torch.float64)[:, None, None] * (math.pi / 2)
    phase = torch.linspace(0.3, 6.0, 100, dtype=torch.float64)[:, None].expand(100, 400)
    exact = ReadoutOptions(electrons_per_count=1.0, converter_bits=24)
    options = exact.model_copy(update={"read_noise_electrons": read_noise})
    counts = read_out(background + amplitude * torch.cos(phase + quarters), options, generator)
    noise = torch.atan2(counts[3] - counts[1], counts[0] - counts[2]) - phase
    noise = torch.remainder(noise + math.pi, 2 * math.pi) - math.pi
    metres = noise * SPEED_OF_LIGHT / (4 * math.pi * frequency)
    # Read noise adds its variance to that of the photo-electrons.
    variance = background + read_noise**2
    expected = SPEED_OF_LIGHT / (4 * math.pi * frequency) * math.sqrt(variance / 2) / amplitude
    assert metres.std().item() == pytest.approx(expected, rel=0.02)
    assert metres.mean().item() == pytest.approx(0.0, abs=5 * expected / 200)


def test_converter_counts_whole_numbers_within_its_scale(generator: Generator) -> None:
    taps = torch.linspace(0.0, 5e6, 4000, dtype=torch.float64).reshape(4, 10, 100)
    counts = read_out(taps, ReadoutOptions(converter_bits=12), generator)
    assert torch.equal(counts, counts.round())
    assert counts.min() >= 0
    assert counts.max() == 4095


def test_full_and_dim_pixels_have_no_distance(generator: Generator) -> None:
    state = measure(0.3, generator=generator, readout={"converter_bits": 14})
    full = (state.raw >= 2**14 - 1).any(0)
    assert full.any()
    assert torch.equal(state.measured_distance.isnan(), full)
    state = measure(1.0, 0.9, generator=generator, readout={"least_amplitude_counts": 1500.0})
    dim = state.measured_amplitude < 1500
    assert 0 < int(dim.sum()) < dim.numel()
    assert torch.equal(state.measured_distance.isnan(), dim)
