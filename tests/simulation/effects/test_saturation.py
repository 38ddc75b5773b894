"""Taps that clip: where nothing is left of a signal, it has no phase."""

from pathlib import Path

import diagnosed_recordings

from tofcorr.simulation.effects.saturation import SaturationEffect, SaturationShape


def test_a_pixel_whose_four_taps_all_clip_has_no_shift_that_rounding_decides(
    tmp_path: Path,
) -> None:
    few = {"shots": [{"target": "white", "poses": 2}]}
    recording = diagnosed_recordings.recorded(tmp_path / "few", 5, [], few, noise=False)
    inputs = diagnosed_recordings.true_inputs(recording, diagnosed_recordings.options(5, [], few))
    # At a contrast of one half the darkest tap is the amplitude: far above every knee.
    full = 0.1 * float(inputs.known_amplitude.min())
    effect = SaturationEffect(SaturationShape(full_counts=full, contrast=0.5))
    assert float(effect.columns(inputs)[:, 1:].abs().max()) == 0.0
