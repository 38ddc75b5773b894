"""Four samples: synthesis, demodulation, and the circular error between them."""

import math
from types import SimpleNamespace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from tofcorr.errors import ConfigError
from tofcorr.geometry.rays import phase_from_radial_distance, unambiguous_range
from tofcorr.simulation.hooks import FrameState
from tofcorr.simulation.signal import (
    Harmonic,
    correlation_samples,
    demodulate,
    distance_from_phase,
    harmonic_tensors,
)

FREQUENCY = 20.0e6


def _turned(orders: Tensor, distance: Tensor) -> Tensor:
    light = SimpleNamespace(orders=orders, modulation_frequency=FREQUENCY)
    return FrameState.path_phasor(light, distance)  # pyright: ignore[reportArgumentType]


def _distance_error(distance: Tensor, harmonics: tuple[Harmonic, ...]) -> Tensor:
    orders, relative = harmonic_tensors(harmonics)
    signal = 100.0 * relative[:, None, None] * _turned(orders, distance)
    samples = correlation_samples(orders, signal, torch.full_like(distance, 500.0))
    return distance_from_phase(demodulate(samples)[0], FREQUENCY) - distance


@given(
    phase=st.floats(0.0, 2 * math.pi - 1e-6),
    amplitude=st.floats(0.1, 1e5),
    offset=st.floats(0.0, 1e6),
)
def test_demodulation_inverts_synthesis(phase: float, amplitude: float, offset: float) -> None:
    quarters = torch.arange(4, dtype=torch.float64)[:, None, None] * (math.pi / 2)
    found = [x.item() for x in demodulate(offset + amplitude * torch.cos(phase + quarters))]
    # The samples are rounded at the scale of the offset.
    rounding = 1e-14 * (1 + offset / amplitude)
    turn = (found[0] - phase + math.pi) % (2 * math.pi) - math.pi
    assert turn == pytest.approx(0.0, abs=10 * rounding)
    assert found[1] == pytest.approx(amplitude, rel=10 * rounding)
    assert found[2] == pytest.approx(offset, rel=1e-12, abs=1e-10 * amplitude)


@pytest.mark.parametrize("even", [(), (Harmonic(order=2, share=0.2), Harmonic(order=4, share=0.1))])
def test_a_sine_and_even_harmonics_return_the_true_distance(even: tuple[Harmonic, ...]) -> None:
    distance = torch.linspace(0.01, 7.4, 500, dtype=torch.float64)[None]
    assert _distance_error(distance, even).abs().max() < 1e-9


def test_circular_error_of_a_third_harmonic_is_the_derived_one() -> None:
    # A0 - A2 = 2 (cos p + s cos 3p) and A3 - A1 = 2 (sin p - s sin 3p), so the phase read is that
    # of exp(jp) (1 + s exp(-4jp)).
    share = 0.05
    distance = torch.linspace(0.2, 7.2, 300, dtype=torch.float64)[None]
    phase = phase_from_radial_distance(distance, FREQUENCY)
    turned = torch.atan2(-share * torch.sin(4 * phase), 1 + share * torch.cos(4 * phase))
    expected = turned * unambiguous_range(FREQUENCY) / (2 * math.pi)
    found = _distance_error(distance, (Harmonic(order=3, share=share),))
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-12)


def test_longer_path_turns_every_harmonic_as_distance_does() -> None:
    orders, _ = harmonic_tensors((Harmonic(order=3, share=0.1),))
    distance = torch.tensor([[0.7, 2.1]], dtype=torch.float64)
    longer = torch.full_like(distance, 0.45)
    near, far = _turned(orders, distance), _turned(orders, distance + longer)
    torch.testing.assert_close(near * _turned(orders, longer), far)


@pytest.mark.parametrize("order", [1, 1001, 10**400])
def test_an_overtone_that_no_light_has_is_refused(order: int) -> None:
    # An integer of 400 digits once ended in an OverflowError.
    with pytest.raises(ConfigError, match="'order'"):
        Harmonic.from_mapping({"order": order, "share": 0.1}, "simulator.yaml")
