"""The noise as a function of brightness: a law of physics where data are few."""

import numpy as np
import pytest
import torch

from tofcorr.diagnosis.sums.noise import PixelNoise, noise_curve, with_residuals


def _at(brightness: float, knots: np.ndarray, sigma: np.ndarray) -> float:
    return float(np.exp(np.interp(np.log(brightness), knots, np.log(sigma))))


@pytest.mark.parametrize("power", [1, 2], ids=["shot noise", "background light"])
def test_the_law_goes_on_in_the_dark(power: int) -> None:
    """Variances of 1 / A and of 1 / A^2 between 100 and 400, asked for at 20."""
    brightness = np.geomspace(100.0, 400.0, 8)
    variance = 1e-3 / brightness**power
    knots, sigma = noise_curve(brightness, variance, np.full(8, 1e4))
    assert _at(20.0, knots, sigma) == pytest.approx(np.sqrt(1e-3 / 20.0**power), rel=0.05)


def test_one_brightness_tells_shot_noise() -> None:
    knots, sigma = noise_curve(np.array([100.0]), np.array([4e-6]), np.array([30.0]))
    assert _at(100.0, knots, sigma) == pytest.approx(2e-3, rel=0.01)
    assert _at(25.0, knots, sigma) == pytest.approx(4e-3, rel=0.05)


def test_many_differences_overrule_the_law() -> None:
    """A step that no law of physics makes is kept."""
    brightness = np.geomspace(100.0, 400.0, 8)
    variance = np.where(brightness > 200, 9e-6, 1e-6)
    knots, sigma = noise_curve(brightness, variance, np.full(8, 1e6))
    assert _at(120.0, knots, sigma) == pytest.approx(1e-3, rel=0.05)
    assert _at(330.0, knots, sigma) == pytest.approx(3e-3, rel=0.05)


@pytest.mark.parametrize("dark", [10, 4000], ids=["too few", "many"])
def test_residuals_say_the_noise_of_dark_pixels_if_there_are_enough(dark: int) -> None:
    knots, sigma = noise_curve(np.array([100.0]), np.array([4e-6]), np.array([1e4]))
    noise = PixelNoise(knots=knots, sigma=sigma, factor=np.ones(1))
    brightness = torch.full((dark,), 25.0, dtype=torch.float64)
    frame = torch.zeros(dark, dtype=torch.int64)
    generator = torch.Generator().manual_seed(1)
    deviation = 0.01 * torch.randn(dark, generator=generator, dtype=torch.float64)
    seen = with_residuals(noise, brightness, frame, deviation)
    expected = 4e-3 if dark == 10 else 0.01
    assert _at(25.0, seen.knots, seen.sigma) == pytest.approx(expected, rel=0.06)
    assert _at(100.0, seen.knots, seen.sigma) == pytest.approx(2e-3, rel=0.02)
