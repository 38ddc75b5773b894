"""Delays become distance errors one to one."""

import numpy as np
import pytest
import torch
from simulation.small import expected_frames, small

from tofcorr.geometry.rays import ray_directions
from tofcorr.simulation.signal import (
    AmplitudeDelayOptions,
    Curve,
    PixelDelayOptions,
    image_from_lattice,
    pixel_delay,
)


def test_constant_delay_and_fast_clock_read_too_far() -> None:
    options = small(sensor={"delays": {"constant_mm": 12.0, "clock_deviation": 0.004}})
    for state in expected_frames(options):
        error = state.measured_distance - state.radial_distance
        torch.testing.assert_close(error, 0.012 + 0.004 * state.radial_distance)


def test_measured_tables_come_out_as_they_went_in() -> None:
    def cubic(x: np.ndarray) -> np.ndarray:
        return 0.02 - 0.03 * x + 0.02 * x**2 - 0.004 * x**3

    knots = np.linspace(0.2, 3.5, 9)
    counts = np.linspace(0.0, 60_000.0, 7)
    rows, columns = np.linspace(-1, 1, 5)[:, None], np.linspace(-1, 1, 6)
    lattice = 0.004 * rows - 0.003 * columns + 0.002 * rows**2 + 0.001 * columns**2
    measured = {
        "constant_m": 0.01,
        "distance": {"knots": knots.tolist(), "values_m": cubic(knots).tolist()},
        "pixel": {"values_m": lattice.tolist()},
        "amplitude": {"knots": counts.tolist(), "values_m": (1e-7 * counts).tolist()},
    }
    for state in expected_frames(small(sensor={"delays": {"measured": measured}})):
        true, amplitude = state.radial_distance, state.measured_amplitude
        assert amplitude.max() < counts[-1]
        height, width = true.shape
        r = torch.linspace(-1, 1, height, dtype=torch.float64)[:, None]
        c = torch.linspace(-1, 1, width, dtype=torch.float64)
        expected = 0.01 + torch.from_numpy(cubic(true.numpy())) + 1e-7 * amplitude
        expected = expected + 0.004 * r - 0.003 * c + 0.002 * r**2 + 0.001 * c**2
        torch.testing.assert_close(state.measured_distance - true, expected, rtol=0, atol=1e-9)


def test_normalised_amplitude_table_sees_amplitude_times_squared_distance() -> None:
    table = {"knots": [0.0, 1e6], "values_m": [0.0, 1.0], "variable": "normalised_amplitude"}
    options = small(sensor={"delays": {"measured": {"amplitude": table}}})
    for state in expected_frames(options):
        expected = 1e-6 * state.measured_amplitude * state.radial_distance**2
        error = state.measured_distance - state.radial_distance
        torch.testing.assert_close(error, expected, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("law", ["log", "power"])
def test_latency_grows_with_amplitude(law: str) -> None:
    options = AmplitudeDelayOptions.from_mapping({"law": law, "scale_mm": 10.0}, "test")
    delay = options.delay(torch.linspace(0.0, 1e6, 50, dtype=torch.float64))
    assert delay[0] == 0
    assert (delay.diff() > 0).all()
    assert (delay.diff().diff() < 0).all()


def test_cameras_of_one_kind_differ_in_the_irregular_part_alone() -> None:
    rays = ray_directions(small().camera.intrinsics())
    kind = PixelDelayOptions(row_line_mm=5.0, bowl_mm=3.0)
    regular = pixel_delay(kind, rays)
    units = [
        pixel_delay(kind.model_copy(update={"irregular_mm": 2.0, "unit": unit}), rays)
        for unit in (1, 1, 2)
    ]
    assert torch.equal(units[0], units[1])
    assert not torch.equal(units[0], units[2])
    assert (units[0] - regular).std().item() == pytest.approx(2e-3, rel=0.2)


def test_curves_are_constant_beyond_their_knots_and_one_point_is_flat() -> None:
    curve = Curve((1.0, 2.0, 3.0, 4.0), (1.0, 8.0, 27.0, 64.0))
    at = torch.tensor([0.0, 1.5, 3.7, 9.0], dtype=torch.float64, requires_grad=True)
    value = curve(at)
    torch.testing.assert_close(value, at.new_tensor([1.0, 1.5**3, 3.7**3, 64.0]))
    value.sum().backward()
    torch.testing.assert_close(at.grad, at.new_tensor([0.0, 3 * 1.5**2, 3 * 3.7**2, 0.0]))
    assert image_from_lattice(((0.25,),), 3, 4).eq(0.25).all()
