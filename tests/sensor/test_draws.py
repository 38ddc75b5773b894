"""Noise and missing pixels have the statistics that the file states."""

from typing import Any

import pytest
import torch
from optional import present
from sensor.sensors import CAMERA, sensor

from tofcorr.estimation.noise import neighbour_correlation
from tofcorr.sensor.model import SensorModel


def big(**changes: Any) -> SensorModel:
    return sensor(camera=CAMERA.section() | {"width": 200, "height": 150}, **changes)


@torch.no_grad()
def test_draws_have_the_stated_spread_share_and_correlation() -> None:
    noise = {"floor_m": 0.004, "fixed_share": 0.36, "correlation_px": 0.7}
    model = big(noise=noise, dropouts={"base_share": 0.03})
    depth = torch.full((20, 150, 200), 1.5, dtype=torch.float64)
    measured = model(depth, generator=torch.Generator().manual_seed(5))
    error = measured.depth - depth
    # 600 000 draws, correlated over about five pixels: the spread is known to 0.2 %, the share of
    # missing pixels to 0.0003 (one standard deviation).
    assert float(error[measured.valid].std()) == pytest.approx(0.004, rel=0.01)
    assert float((~measured.valid).double().mean()) == pytest.approx(0.03, abs=0.001)
    assert torch.equal(measured.depth.isnan(), ~measured.valid)
    left, right = error[..., :-1], error[..., 1:]
    both = left.isfinite() & right.isfinite()
    correlation = float((left[both] * right[both]).mean() / 0.004**2)
    assert correlation == pytest.approx(neighbour_correlation(0.7, 1), abs=0.01)
    between = (error[0] * error[1])[measured.valid[0] & measured.valid[1]].mean() / 0.004**2
    # 30 000 pixels of a fixed pattern, correlated: known to about 0.015.
    assert float(between) == pytest.approx(0.36, abs=0.05)


@torch.no_grad()
def test_a_generator_decides_every_draw_and_no_noise_draws_nothing() -> None:
    model = big(noise={"floor_m": 0.004}, dropouts={"base_share": 0.1})
    depth = torch.full((150, 200), 1.5, dtype=torch.float64)
    generators = (torch.Generator().manual_seed(seed) for seed in (1, 1, 2))
    first, second, other = (model(depth, generator=one).depth for one in generators)
    assert torch.equal(first.nan_to_num(0.0), second.nan_to_num(0.0))
    assert not torch.equal(first.nan_to_num(0.0), other.nan_to_num(0.0))
    assert torch.equal(model(depth, noise=False).depth, depth)


@torch.no_grad()
def test_a_saturated_pixel_states_the_largest_amplitude_and_is_not_valid() -> None:
    model = sensor(dropouts={"saturation_amplitude": 500.0})
    depth = torch.ones(12, 16, dtype=torch.float64)
    amplitude = torch.full_like(depth, 300.0)
    amplitude[3, 4] = 700.0
    measured = model(depth, amplitude)
    assert float(present(measured.amplitude)[3, 4]) == 500.0
    assert not bool(measured.valid[3, 4])
    assert int(measured.valid.sum()) == 12 * 16 - 1


def test_a_distance_that_its_error_exceeds_is_none() -> None:
    """Light brighter than any measured once turned the phase by half a turn: -2 m were written."""
    model = sensor(effects=[{"name": "integration_time", "reference_us": 1000.0, "log_1": -1.0}])
    far = torch.arange(16).expand(12, 16) > 7
    light = torch.full((12, 16), 800.0, dtype=torch.float64)
    found = model(torch.where(far, 5.0, 0.4).double(), light, integration_time_us=10_000.0)
    assert torch.equal(found.valid, far)
    assert torch.equal(found.depth.isfinite(), far)
