"""Everything that the recording format says a reader must refuse, by its message."""

from pathlib import Path

import numpy as np
import pytest
from broken_recordings import REFUSALS, value

from tofcorr.data.recording import Recording
from tofcorr.errors import CalibrationDataError


@pytest.mark.parametrize("message", REFUSALS)
def test_a_broken_recording_is_refused_by_name(folder: Path, message: str) -> None:
    REFUSALS[message](folder)
    with pytest.raises(CalibrationDataError, match=message) as refusal:
        Recording.open(folder)
    assert str(folder) in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_a_dangling_link_is_refused(folder: Path) -> None:
    (folder / "mask.npy").unlink()
    (folder / "mask.npy").symlink_to(folder / "gone.npy")
    with pytest.raises(CalibrationDataError, match=r"mask\.npy: there is no such file"):
        Recording.open(folder)


def test_a_folder_in_place_of_a_file_is_refused(folder: Path) -> None:
    for name in ("mask.npy", "frames.csv", "recording.yaml"):
        (folder / name).unlink()
        (folder / name).mkdir()
        with pytest.raises(CalibrationDataError, match=name):
            Recording.open(folder)
        (folder / name).rmdir()
        (folder / name).write_text("")


@pytest.mark.parametrize("amplitude", [np.nan, np.inf, 0.0])
def test_only_a_negative_amplitude_is_a_reason_to_refuse(folder: Path, amplitude: float) -> None:
    value("amplitude", (4, 2, 3), amplitude)(folder)
    assert Recording.open(folder).num_frames == 6
