"""The noise model finds the noise that was put in."""

from pathlib import Path

import numpy as np
import pytest
import torch
from simulated_walls import SENSOR, simulated_wall
from torch import Generator

from tofcorr.errors import CalibrationDataError
from tofcorr.estimation.noise import DistanceNoise, fit_noise, neighbour_differences
from tofcorr.pixels.lattice import estimate_noise

TRUE = DistanceNoise(1e-6, 2e-3, 0.5, "repeats")


def drawn(generator: Generator, number: int = 200_000) -> tuple[torch.Tensor, torch.Tensor]:
    uniform = torch.rand(number, generator=generator, dtype=torch.float64)
    amplitude = 100.0 * 100.0**uniform
    normal = torch.randn(2, number, generator=generator, dtype=torch.float64)
    both = normal * TRUE.variance(amplitude).sqrt()
    return both[0] - both[1], amplitude


@pytest.mark.parametrize(("off", "most"), [(0.0, 1.1), (1.0, 1.6)])
def test_the_variance_is_found_though_a_tenth_of_the_pixels_is_off(
    off: float, most: float, generator: Generator
) -> None:
    difference, amplitude = drawn(generator)
    difference[::10] += off
    found = fit_noise(difference, amplitude, "repeats")
    amplitude = torch.logspace(2, 4, 20, dtype=torch.float64)
    ratio = found.variance(amplitude) / TRUE.variance(amplitude)
    assert float(ratio.min()) > 0.9
    assert float(ratio.max()) < most


def test_the_variance_is_never_negative_and_no_amplitude_tells_nothing() -> None:
    variance = TRUE.variance(torch.tensor([0.0, 1.0, 1e9], dtype=torch.float64))
    assert float(variance[0]) == float("inf")
    assert float(variance.min()) > 0


def test_exact_repeats_and_too_few_pixels_are_refused() -> None:
    with pytest.raises(CalibrationDataError, match="Copies of one frame"):
        fit_noise(torch.zeros(100), torch.ones(100), "repeats")
    with pytest.raises(CalibrationDataError, match="3 usable differences"):
        fit_noise(torch.ones(3), torch.ones(3), "neighbours")


def test_neighbours_on_a_noise_free_tilted_plane_do_not_differ() -> None:
    sides = (torch.linspace(-end, end, 30, dtype=torch.float64) for end in (0.4, 0.3))
    columns, rows = torch.meshgrid(*sides, indexing="xy")
    rays = torch.stack([columns, rows, torch.ones_like(rows)], dim=-1)
    rays = rays / rays.norm(dim=-1, keepdim=True)
    normal = torch.tensor([0.4, -0.3, -0.9]).double()
    distance = (-1.2 / (rays @ (normal / normal.norm())))[None]
    ones = torch.ones_like(distance)
    found, _ = neighbour_differences(distance, ones, ones > 0, rays)
    assert float(found.abs().max()) < 1e-12


def test_repeats_and_neighbours_of_one_camera_agree(tmp_path: Path) -> None:
    robot = {"repeat_poses": 30, "repeat_frames": 2}
    dataset = simulated_wall(tmp_path / "wall", sensor=SENSOR, robot=robot)
    every = np.arange(dataset.num_frames)
    repeats = estimate_noise(dataset, every)
    once = estimate_noise(dataset, every[::2])
    assert (repeats.source, once.source) == ("repeats", "neighbours")
    amplitude = torch.logspace(2.3, 3.7, 10, dtype=torch.float64)
    ratio = once.variance(amplitude) / repeats.variance(amplitude)
    assert float(ratio.min()) > 0.8
    assert float(ratio.max()) < 1.5
