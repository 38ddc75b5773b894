"""What of the scene's light a corrector removes is measured from the recording."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from training.trained import CONFIG, Trained

import tofcorr
from tofcorr.correction.state import SceneLight
from tofcorr.errors import CalibrationDataError, ConfigError

NAMED = CONFIG | {"advice": 0, "runtime": {"flying_pixels": {"false_alarm": 1e-3}}}


def before_a_board(recording: Path, folder: Path) -> Path:
    """Copy a recording of a wall, with the near half of another one in front of every image."""
    shutil.copytree(recording, folder)
    depth, amplitude = (np.load(folder / f"{name}.npy") for name in ("depth", "amplitude"))
    middle = depth.shape[2] // 2
    near, bright = 0.7 * depth, 3 * amplitude
    share = np.zeros(depth.shape[1:], np.float32)
    share[:, :middle] = 1.0
    share[:, middle] = 0.5
    light = share * bright + (1 - share) * amplitude
    mixed = (share * bright * near + (1 - share) * amplitude * depth) / light
    np.save(folder / "depth.npy", mixed.astype(np.float32))
    np.save(folder / "amplitude.npy", light.astype(np.float32))
    mask = np.repeat((share == 0)[None], len(depth), axis=0)
    np.save(folder / "mask.npy", mask.astype(np.uint8))
    return folder


def test_what_was_not_named_is_not_looked_for(trained: Trained) -> None:
    assert trained.calibration()["scene"] == SceneLight().to_mapping()


def test_where_a_recording_shows_none_they_are_not_looked_for(trained: Trained) -> None:
    result = tofcorr.train(trained.recording, NAMED)
    assert result.corrector().flying is None
    assert result.report["scene"] == {"flying_pixels": {"held_out_share": None}}
    assert "Flying pixels are not looked for: the recording shows none." in repr(result)


def test_where_boards_stand_before_walls_the_column_between_them_is_not_valid(
    trained: Trained, tmp_path: Path
) -> None:
    folder = before_a_board(trained.recording, tmp_path / "board")
    result = tofcorr.train(folder, NAMED)
    found = result._state.scene.flying_pixels
    assert found is not None
    assert found.false_alarm == 1e-3
    # The edge is as sharp as an area can be that half a pixel's step goes through.
    assert 0.2 < found.point_spread_px < 0.6
    depth, amplitude = (
        torch.from_numpy(np.load(folder / f"{n}.npy")) for n in ("depth", "amplitude")
    )
    flying, _ = result.corrector().flying.found(depth, amplitude)  # type: ignore[union-attr]
    middle = depth.shape[2] // 2
    assert flying[:, 2:-2, middle].float().mean() > 0.9
    # Half the frames were held out: what the report says of them is about what all show.
    share = result.report["scene"]["flying_pixels"]["held_out_share"]
    assert share == pytest.approx(float(flying.float().mean()), rel=0.2)
    assert f"Flying pixels are {100 * share:.2g} % of all pixels" in repr(result)
    beside = flying.float().mean(dim=(0, 1))
    assert beside[: middle - 1].max() < 0.05
    assert beside[middle + 2 :].max() < 0.05


def test_without_amplitudes_they_are_refused_in_words(trained: Trained, tmp_path: Path) -> None:
    folder = tmp_path / "dark"
    shutil.copytree(trained.recording, folder)
    (folder / "amplitude.npy").unlink()
    plain = NAMED | {"model": {"terms": [{"kind": "distance_polynomial", "degree": 1}]}}
    with pytest.raises(CalibrationDataError, match=r"amplitude.*flying pixels"):
        tofcorr.train(folder, plain).corrector()


def test_a_rate_that_is_none_is_refused(trained: Trained) -> None:
    wrong = NAMED | {"runtime": {"flying_pixels": {"false_alarm": 0}}}
    with pytest.raises(ConfigError, match="false_alarm"):
        tofcorr.train(trained.recording, wrong)


def test_the_report_says_what_removing_light_changes_in_held_out_frames(trained: Trained) -> None:
    stray = {"modulation_frequency": 20e6, "sigma_of_width": [0.1], "shares": [0.05]}
    wanted = CONFIG | {"advice": 0, "runtime": {"stray_light": stray}}
    result = tofcorr.train(trained.recording, wanted)
    left, without = result.report["scene"]["stray_light"]["held_out_rms_mm"]
    # Without it frames are those that the errors of the report are of.
    assert without == pytest.approx(result.report["error_mm"]["after"]["test"]["rms"])
    assert left != pytest.approx(without)
    said = f"Held-out frames are off by {left:.1f} mm RMS with stray light and {without:.1f} mm"
    assert said in repr(result)
