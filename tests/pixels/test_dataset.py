"""Only recordings of one camera in one setting are calibrated together."""

from pathlib import Path
from typing import Any

import pytest
from small_recordings import write_small_recording

from tofcorr.data.recording import Recording
from tofcorr.errors import CalibrationDataError
from tofcorr.geometry.frame_names import FrameNames
from tofcorr.pixels.dataset import Dataset


def test_no_recording_is_refused() -> None:
    with pytest.raises(CalibrationDataError, match="There is no recording to calibrate"):
        Dataset(())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"modulation_frequency": 30e6}, "its modulation_frequency is 30000000.0, that of .*one"),
        ({"depth_kind": "z"}, "its depth_kind is z, that of .*one is radial"),
        (
            {"frame_names": FrameNames(eye_to_hand=True)},
            "the camera stands still in one of this and .*one, and the robot carries it",
        ),
    ],
)
def test_a_recording_of_another_setting_is_refused_with_both_values(
    change: dict[str, Any], message: str, tmp_path: Path
) -> None:
    one = Recording.open(write_small_recording(tmp_path / "one"))
    other = Recording.open(write_small_recording(tmp_path / "other", **change))
    assert Dataset((one, one)).num_frames == 2 * one.num_frames
    with pytest.raises(CalibrationDataError, match=message):
        Dataset((one, other))
