"""A calibration's file keeps what exports need, and files of older versions stay readable."""

from pathlib import Path

import torch
from correction.export.states import ACCURACY, EYE_TO_HAND, TRANSFORMS, calibration

from tofcorr.correction.state import load_calibration, save_calibration
from tofcorr.geometry.camera import FrameNames


def test_names_and_standard_errors_survive(tmp_path: Path) -> None:
    accuracy = ACCURACY.model_copy(update={"undetermined": ("t_z and c0 together (corr +0.99)",)})
    state = calibration(TRANSFORMS["general"], frames=EYE_TO_HAND, hand_eye_accuracy=accuracy)
    save_calibration(tmp_path / "state.pt", state)
    again = load_calibration(tmp_path / "state.pt")
    assert again.frames == EYE_TO_HAND
    assert again.hand_eye_accuracy == accuracy
    assert torch.equal(again.tool_from_camera, state.tool_from_camera)


def test_a_file_without_them_is_read(tmp_path: Path) -> None:
    save_calibration(tmp_path / "state.pt", calibration(TRANSFORMS["general"]))
    values = torch.load(tmp_path / "state.pt", weights_only=True)
    del values["frames"], values["hand_eye_accuracy"]
    torch.save(values, tmp_path / "old.pt")
    old = load_calibration(tmp_path / "old.pt")
    assert old.frames == FrameNames()
    assert old.hand_eye_accuracy is None
