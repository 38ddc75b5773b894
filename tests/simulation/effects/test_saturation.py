"""Taps that clip, and charge that spills from them."""

import pytest
import torch
from simulation.effects.scenes import plain_inputs

from tofcorr.simulation.effects.base import EffectInputs
from tofcorr.simulation.effects.saturation import SaturationEffect, SaturationShape, spilled


@pytest.fixture(scope="module")
def bright(tmp_path_factory: pytest.TempPathFactory) -> EffectInputs:
    return plain_inputs(tmp_path_factory.mktemp("bright"), "white", 2)


def test_a_pixel_whose_four_taps_clip_has_no_shift_of_rounding(bright: EffectInputs) -> None:
    # At a contrast of one half the darkest tap is the amplitude: far above every knee.
    full = 0.1 * float(bright.known_amplitude.min())
    effect = SaturationEffect(SaturationShape(full_counts=full, contrast=0.5))
    assert float(effect.columns(bright)[:, 1:-2].abs().max()) == 0.0


def test_charge_spills_where_a_tap_is_full_and_nowhere_else(bright: EffectInputs) -> None:
    # At a contrast of one half the brightest tap is at most three times the amplitude.
    most = 3 * float(bright.known_amplitude.max())
    spilt = [
        SaturationEffect(SaturationShape(full_counts=full, spill_knee=1.0)).columns(bright)[:, -2:]
        for full in (0.5 * most, 1.001 * most)
    ]
    assert float(spilt[0].abs().amax(0).min()) > 1e-3
    assert float(spilt[1].abs().max()) < 1e-12


@pytest.mark.parametrize("axis", [-2, -1])
def test_what_runs_from_a_full_pixel_stays_on_its_line_and_is_what_it_had(axis: int) -> None:
    over = torch.zeros(9, 9, dtype=torch.float64)
    over[4, 4] = 100.0
    received = spilled(over, axis)
    line = received.movedim(axis, -1)[4]
    assert float(received.sum()) == pytest.approx(100.0)
    assert float(line.sum()) == pytest.approx(100.0)
    assert float(line[4]) == 0.0
    torch.testing.assert_close(line, line.flip(0))
    assert float(line[5] / line[7]) == pytest.approx(torch.e)
    over[4, 4], over[0, 0] = 0.0, 100.0  # Half of it runs beyond the edge.
    assert float(spilled(over, axis).sum()) == pytest.approx(50.0)
