"""Several cameras calibrated together: what is written and said of them."""

import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from running import Program
from simulated_walls import simulated_wall
from training.trained import CONFIG, FILES

import tofcorr
from tofcorr import CalibrationDataError, ConfigError
from tofcorr.training.judgement import VERDICTS


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("rig")
    simulated_wall(folder / "front", 7)
    beside = {"robot_of": str(folder / "front"), "frames": {"camera": "rear_optical"}}
    simulated_wall(folder / "other", 8, **beside, hand_eye={"rotation_deg": [5.0, 12.0, -60.0]})
    return [folder / "front", folder / "other"]


def test_every_camera_has_its_run_and_the_rig_its_transforms(
    recordings: list[Path], tmp_path: Path, program: Program
) -> None:
    config, out = tmp_path / "config.yaml", tmp_path / "cell"
    config.write_text(yaml.safe_dump(CONFIG | {"planes": "unknown"}))
    code, printed, _ = program("rig", *recordings, "--config", config, "--out", out)
    assert code == 0
    assert {one.name for one in out.iterdir()} == {"front", "rear_optical", "rig.json", "rig.yaml"}
    for name in ("front", "rear_optical"):
        assert {one.name for one in (out / name).iterdir()} == FILES
    report = json.loads((out / "rig.json").read_text())
    assert report["verdict"] in VERDICTS
    assert printed.startswith(f"Verdict: {report['verdict']}. ")
    assert len(printed.splitlines()) <= 13  # 12, and what was written.
    (transform,) = report["transforms"]
    assert (transform["parent"], transform["child"]) == ("front", "rear_optical")
    mounts = [np.array(one["hand_eye"]["tool_from_camera"]) for one in report["cameras"].values()]
    between = np.linalg.inv(mounts[0]) @ mounts[1]
    assert np.allclose(transform["parent_from_child"], between, atol=1e-12)
    assert report["walls"][0]["cameras"] == ["front", "rear_optical"]
    assert yaml.safe_load((out / "rig.yaml").read_text())["walls"] == report["walls"]


def test_two_cameras_of_one_name_are_refused(recordings: list[Path], tmp_path: Path) -> None:
    twice = [tofcorr.Recording.open(recordings[0])] * 2
    with pytest.raises(CalibrationDataError, match=r"a camera called 'front' too\. Name them"):
        tofcorr.rig(twice)


def test_a_camera_without_a_robot_and_a_network_are_refused(
    recordings: list[Path], tmp_path: Path
) -> None:
    simulated_wall(tmp_path / "still", 7, (("white", 4),))
    table = tmp_path / "still" / "frames.csv"
    head, *rows = table.read_text().splitlines()
    place, cells = head.split(",").index("tx"), [row.split(",") for row in rows]
    for row in cells:
        row[place : place + 7] = ["0", "0", "0", "0", "0", "0", "1"]
    table.write_text("\n".join([head, *map(",".join, cells)]))
    with pytest.raises(CalibrationDataError, match="no robot moves this camera"):
        tofcorr.rig([recordings[0], tmp_path / "still"])
    with pytest.raises(ConfigError, match="residual: null"):
        tofcorr.rig(recordings, CONFIG | {"residual": {}})
