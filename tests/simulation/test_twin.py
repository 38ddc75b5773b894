"""The simulator run again at recorded poses, as a twin of a recording."""

from pathlib import Path

import numpy as np
import pytest
import torch
from optional import present
from simulation.small import IMPERFECT, small

from tofcorr.data.recording import Recording
from tofcorr.errors import CalibrationDataError, ConfigError
from tofcorr.simulation.simulator import simulate, twin_frames


def test_twin_at_recorded_poses_equals_the_simulation(tmp_path: Path) -> None:
    conditions = {"integration_time_us": [300.0, 600.0], "ambient_counts": [50.0, 400.0]}
    options = small(sensor=IMPERFECT, conditions=conditions)
    recording = simulate(options, tmp_path / "r", noise=False)
    amplitudes = recording.require("amplitude", "this test")
    for state in twin_frames(options, recording):
        depth, amplitude = recording.depth[state.index], amplitudes[state.index]
        # The quaternions of the file are good to 1e-16; depth is stored as float32.
        np.testing.assert_allclose(depth, state.measured_distance, atol=3e-7)
        np.testing.assert_allclose(amplitude, state.measured_amplitude, rtol=1e-6)


def test_a_twin_sees_the_recorded_brightness_or_says_that_it_is_missing(tmp_path: Path) -> None:
    recording = simulate(small(sensor=IMPERFECT), tmp_path / "r", noise=False)
    blind = small(scene={"targets": {}}, sensor={"delays": IMPERFECT["delays"]})
    with pytest.raises(ConfigError, match=r"no target '(white|checkerboard)'"):
        list(twin_frames(blind, recording))
    for state in twin_frames(blind, recording, reflectivity="from_recording"):
        amplitude = present(recording.amplitude)[state.index]
        np.testing.assert_allclose(state.measured_amplitude, amplitude, rtol=1e-6)
    (tmp_path / "r/amplitude.npy").unlink()
    dark = Recording.open(tmp_path / "r")
    with pytest.raises(CalibrationDataError, match=r"amplitude.npy is missing; a twin"):
        list(twin_frames(blind, dark, reflectivity="from_recording"))


def test_twin_uses_the_hand_eye_transform_it_is_given(tmp_path: Path) -> None:
    options = small()
    recording = simulate(options, tmp_path / "r", noise=False)
    shifted = options.hand_eye.tool_from_camera()
    shifted[:3, 3] += torch.tensor([0.0, 0.0, 0.01], dtype=torch.float64)
    usual = list(twin_frames(options, recording))
    moved = list(twin_frames(options, recording, tool_from_camera=shifted, indices=[2]))
    assert len(moved) == 1
    assert moved[0].index == 2
    change = moved[0].radial_distance - usual[2].radial_distance
    assert change.abs().max() > 0.005
