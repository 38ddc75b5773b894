"""Several cameras calibrated together: what is written and said of them."""

import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from running import Program
from simulated_walls import QUIET, simulated_wall
from training.trained import CONFIG, FILES

import tofcorr
from tofcorr import CalibrationDataError, ConfigError
from tofcorr.simulation.options import ArmOptions
from tofcorr.training.judgement import VERDICTS


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("rig")
    simulated_wall(folder / "front", 7)
    beside = {"robot_of": str(folder / "front"), "frames": {"camera": "rear_optical"}}
    simulated_wall(folder / "other", 8, **beside, hand_eye={"rotation_deg": [5.0, 12.0, -60.0]})
    return [folder / "front", folder / "other"]


@pytest.mark.slow
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


OFFSETS = [0.15, -0.2, 0.3, -0.1, 0.25, 0.2]


@pytest.fixture(scope="module")
def arm_recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("arm") / "wall"
    robot = {"distance_m": [0.5, 1.1], "arm": {"offsets_deg": OFFSETS}}
    scene = {"subsamples": 2, "plane": {"normal": [-1, 0, 0], "offset_m": 1.3}}
    simulated_wall(path, 7, (("white", 30),), QUIET, robot=robot, scene=scene)
    return path


@pytest.mark.parametrize("planes", ["known", "unknown"])
def test_offsets_of_joints_are_found_or_named(arm_recording: Path, planes: str) -> None:
    config = CONFIG | {"planes": planes, "split": {"test_fraction": 0.0}, "advice": 0}
    result = tofcorr.rig(arm_recording, config, urdf=ArmOptions().file)
    joints = {one["joint"]: one for one in result.report["joints"]}
    same = {name: one["same_as"] for name, one in joints.items() if one["ci95"] is None}
    camera, walls = (f"a turn of {what} about its axis" for what in ("the camera", "all walls"))
    assert same == ({} if planes == "known" else {"pan": walls}) | {"wrist_3": camera}
    off = [
        (one["offset"] - true) / one["ci95"]
        for one, true in zip(joints.values(), OFFSETS, strict=True)
        if one["ci95"] is not None
    ]
    # Half-widths of 95 %: two of them are four standard errors.
    assert max(map(abs, off)) < 2
    assert max(one["ci95"] or 0 for one in joints.values()) < 0.2
    assert f"The offset of wrist_3 is the same as {camera}; 0 is used." in repr(result)
    assert len(repr(result).splitlines()) <= 12


def test_what_has_no_joint_angles_or_those_of_another_arm_is_refused(
    recordings: list[Path], arm_recording: Path, tmp_path: Path
) -> None:
    with pytest.raises(CalibrationDataError, match=r"columns 'joint_1', 'joint_2', \.\.\. are mis"):
        tofcorr.rig(recordings, urdf=ArmOptions().file)
    shorter = tmp_path / "arm.urdf"
    shorter.write_text(ArmOptions().file.read_text().replace("0 0 0.43", "0 0 0.33"))
    with pytest.raises(ConfigError, match="poses and joint angles disagree by up to 0"):
        tofcorr.rig(arm_recording, urdf=shorter)
    shorter.write_text(
        ArmOptions().file.read_text().replace('"pan" type="revolute"', '"pan" type="fixed"')
    )
    with pytest.raises(CalibrationDataError, match="6 joint angles, the URDF has 5: lift, "):
        tofcorr.rig(arm_recording, urdf=shorter)
