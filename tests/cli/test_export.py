"""`tofcorr train` and `tofcorr export` on a recording with named frames."""

import json
from pathlib import Path

import numpy as np
import yaml
from correction.export.states import calibration
from running import Program
from simulated_walls import simulated_wall

from tofcorr.correction.state import STATE_FILE, save_calibration

FRAMES = {"world": "tool0", "tool": "base_link", "camera": "tof_optical", "eye_to_hand": True}


def test_the_names_of_a_recording_stand_in_report_calibration_and_exports(
    tmp_path: Path, program: Program
) -> None:
    folder = simulated_wall(tmp_path / "wall").first.path
    header = yaml.safe_load((folder / "recording.yaml").read_text())
    (folder / "recording.yaml").write_text(yaml.safe_dump(header | {"frames": FRAMES}))
    out = tmp_path / "run"
    train = ("train", "--recording", folder, "--out", out, "--set", "advice=0")
    assert "hand-eye translation of tof_optical in base_link, mm:" in program(*train).out

    report = json.loads((out / "report.json").read_text())
    assert report["hand_eye"]["frames"] == FRAMES
    assert report["hand_eye"]["undetermined"] == []
    in_yaml = yaml.safe_load((out / "calibration.yaml").read_text())["hand_eye"]
    assert in_yaml["frames"] == FRAMES

    urdf = tmp_path / "camera.xacro"
    assert program("export", "--run", out, "--format", "urdf", "--out", urdf).code == 0
    errors = " ".join(f"{value:.3f}" for value in report["hand_eye"]["translation_se_mm"])
    assert f"{errors} mm" in urdf.read_text()
    assert '<parent link="base_link"' in urdf.read_text()

    arm = tmp_path / "arm.calib"
    assert program("export", "--run", out, "--format", "easy_handeye", "--out", arm).code == 0
    assert yaml.safe_load(arm.read_text())["parameters"]["calibration_type"] == "eye_on_base"


def test_a_run_that_is_not_to_be_used_is_exported_only_if_it_was_forced(
    tmp_path: Path, program: Program
) -> None:
    # Only corrector.ts was held back: any other format was written, without a word.
    save_calibration(tmp_path / STATE_FILE, calibration(np.eye(4), hand_eye_estimated=True))
    report = {"verdict": "do not use", "reason": "The wall is bent."}
    (tmp_path / "report.json").write_text(json.dumps(report))
    out = tmp_path / "table.npz"
    export = ("export", "--run", tmp_path, "--format", "lut", "--out", out)
    code, _, told = program(*export)
    assert code == 2
    assert "its verdict is `do not use`: The wall is bent. Train with" in told
    assert not out.exists()
    (tmp_path / "corrector.ts").touch()  # As `tofcorr train --force` leaves it.
    code, said, _ = program(*export)
    assert code == 0
    assert "Verdict: do not use. The wall is bent." in said
    assert out.exists()
