"""Degraded frames against the truth of another session: by hand, and by laws of the generator."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks.withheld.generator.conditions import LAG
from benchmarks.withheld.generator.pairs import Pair
from benchmarks.withheld.generator.writing import write_recording
from benchmarks.withheld.pairs.degraded import gap_of, noise_of, oracle_error, within
from benchmarks.withheld.reading import read
from tofcorr.simulation.effects.room_temperature import lagged_by


def test_a_gap_is_weighted_by_the_noise_and_leaves_gross_errors_out() -> None:
    error, sigma = np.zeros((2, 1, 3)), np.full((2, 1, 3), 1e-3)
    error[:, 0, 0], error[0, 0, 1] = 4e-3, np.nan
    error[1, 0, 2], sigma[:, 0, 0] = 0.1, 5e-3  # Gross; a noise of 5 mm halves the weight.
    light = 1 / 1.04
    wanted = 4 * np.sqrt(1.0 / (1.0 + 2 * light))  # First frame: pixels 0, 2; second: 0, 1.
    assert gap_of(error, sigma, np.arange(2))[0] == pytest.approx(wanted)


def test_what_no_pixel_of_a_recording_was_like_does_not_count(tmp_path: Path, ideal: Pair) -> None:
    write_recording(tmp_path / "real", ideal.real)
    real = read(tmp_path / "real")
    assert real.amplitude is not None
    assert within(real, real)[real.valid].all()
    brighter = replace(real, amplitude=real.amplitude.max() + 1.0 + real.amplitude)
    assert not within(brighter, real).any()
    assert not within(replace(real, depth=real.depth + 5.0), real).any()


def test_noise_is_compared_where_both_cameras_see_the_target() -> None:
    sigma, true = np.full((1, 2, 2), 2e-3), np.ones((1, 2, 2))
    deviation = np.full((1, 2, 2), 2e-3)
    sigma[0, 0, 0] = deviation[0, 0, 0] = 0.05  # A dark pixel that the camera does not see.
    true[0, 0, 0] = np.nan
    assert noise_of(deviation, sigma, true) == pytest.approx((2.0, 2.0))


def test_noise_has_the_standard_deviation_that_is_sealed(ideal: Pair) -> None:
    ratio = ((ideal.real.depth - ideal.expected) / ideal.sigma)[ideal.real.mask]
    # 24 000 pixels: their mean square is known to 1 %; first order leaves some tenths.
    assert np.nanmean(ratio**2) == pytest.approx(1.0, abs=0.03)


def test_a_session_after_rest_holds_its_history_in_its_columns(ideal: Pair) -> None:
    assert ideal.held_out is not None
    world = ideal.held_out.ideal.world
    there, times = world.conditions, world.trajectory.timestamps
    assert there.heat_seconds == ideal.real.world.conditions.heat_seconds
    assert there.fast_heat[0] == there.slow_heat[0] == 0
    # The exact lag of a piecewise linear temperature; the generator takes steps of five seconds.
    followed = lagged_by(LAG, torch.from_numpy(times), torch.from_numpy(there.room_temperature))
    assert np.abs(followed.numpy() - there.lagged_room).max() < 0.1


def test_an_oracle_that_knows_the_effect_leaves_less_of_another_session(
    ideal: Pair, tmp_path: Path
) -> None:
    assert ideal.held_out is not None
    for name, one in (("real", ideal.real), ("ideal", ideal.held_out.ideal)):
        write_recording(tmp_path / name, one)
    real, true = read(tmp_path / "real"), ideal.held_out.expected
    there = replace(read(tmp_path / "ideal"), depth=true, valid=np.isfinite(true))
    (effect,) = ideal.fields
    fields = [(ideal.fields[effect], ideal.held_out.fields[effect])]
    informed, blind = (
        gap_of(oracle_error(real, there, known), ideal.held_out.sigma, np.arange(60))[0]
        for known in (fields, [])
    )
    # Errors of the fit are in both: the effect of 5 mm, less what base terms take up, adds to one.
    assert informed**2 + 4.0**2 < blind**2
