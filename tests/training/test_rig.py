"""Several cameras calibrated together: what is written and said of them."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from running import Program
from simulated_walls import QUIET, simulated_wall, true_hand_eye
from training.trained import CONFIG, FILES

import tofcorr
from tofcorr import CalibrationDataError, ConfigError
from tofcorr.geometry.rays import plane_in_frame
from tofcorr.pixels.dataset import Dataset
from tofcorr.simulation.options import ArmOptions
from tofcorr.training.judgement import VERDICTS
from tofcorr.training.rig import around_cell


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


def standing(path: Path) -> tofcorr.Recording:
    """Return a recording as of a camera that stands still before a target moved by hand."""
    data = Dataset((tofcorr.Recording.open(path),))
    pose = data.column("world_from_tool") @ true_hand_eye(data)
    plane = plane_in_frame(data.column("normal_world"), data.column("offset"), pose)
    normal, offset = (part.numpy() for part in plane)
    still = np.tile(np.eye(4), (len(pose), 1, 1))
    return data.with_columns(world_from_tool=still, normal_world=normal, offset=offset).first


def test_cameras_around_a_cell_find_each_other(recordings: list[Path]) -> None:
    still = [standing(path) for path in recordings]
    # Of the others' planes nothing is used.
    still[1] = replace(still[1], planes="estimated")
    light = {"second_bounces": {"gain": 1e-4}}
    config = CONFIG | {"split": {"test_fraction": 0.0}, "advice": 0, "runtime": light}
    result = tofcorr.rig(still, config)
    assert "second bounces were in the frames of this fit" in repr(result)
    mounts = [true_hand_eye(Dataset((tofcorr.Recording.open(path),))) for path in recordings]
    (found,) = result.report["transforms"]
    off = torch.linalg.solve(*mounts)[:3, 3] - 1e-3 * torch.tensor(found["translation_mm"])
    assert result.report["cameras"]["front"]["hand_eye"]["tool_from_camera"] == np.eye(4).tolist()
    assert result.report["cameras"]["rear_optical"]["hand_eye"]["frames"]["tool"] == "front"
    # Half-widths of 95 %: two of them are four standard errors.
    assert (1e3 * off.abs() < 2 * torch.tensor(found["translation_ci95_mm"])).all()
    assert max(found["known_to_mm_deg"]) < 20


def test_a_camera_around_a_cell_sees_the_planes_of_the_first(recordings: list[Path]) -> None:
    named = {path.name: Dataset((standing(path),)) for path in recordings}
    known = np.random.default_rng(1).normal(size=(named["front"].num_frames, 4, 4))
    named["front"] = named["front"].with_columns(plane_covariance=known)
    for data in around_cell(named).values():
        covariance = data.plane_covariance()
        assert covariance is not None
        assert np.allclose(covariance, known, atol=1e-12)
        columns = "normal_world", "offset", "world_from_tool"
        found = plane_in_frame(*(data.column(name) for name in columns))
        for part, name in zip(found, columns, strict=False):
            assert torch.allclose(part, named["front"].column(name), atol=1e-12)


def test_cameras_that_nothing_relates_and_a_network_are_refused(recordings: list[Path]) -> None:
    still = [standing(path) for path in recordings]
    for pair in ([recordings[0], still[1]], still[:1]):
        with pytest.raises(CalibrationDataError, match="stands still goes with others that do"):
            tofcorr.rig(pair)
    with pytest.raises(CalibrationDataError, match="first camera's planes were not measured"):
        tofcorr.rig([replace(still[0], planes="estimated"), still[1]])
    with pytest.raises(CalibrationDataError, match="first camera's planes were not measured"):
        tofcorr.rig(still, CONFIG | {"planes": "unknown"})
    ids = np.array([f"other {one}" for one in range(still[1].num_frames)])
    other = replace(still[1], frames=replace(still[1].frames, pose_id=ids))
    with pytest.raises(CalibrationDataError, match="has no frame of pose_id 'other 0', whose"):
        tofcorr.rig([still[0], other])
    with pytest.raises(ConfigError, match="residual: null"):
        tofcorr.rig(recordings, CONFIG | {"residual": {}})


OFFSETS, LENGTHS = [0.15, -0.2, 0.3, -0.1, 0.25, 0.2], [0.5, -0.8, 1.0, 0.7, -0.6, 0.9]


def recorded_by_an_arm(path: Path, **arm: list[float]) -> Path:
    robot = {"distance_m": [0.5, 1.1], "arm": {"offsets_deg": OFFSETS, **arm}}
    scene = {"subsamples": 2, "plane": {"normal": [-1, 0, 0], "offset_m": 1.3}}
    simulated_wall(path, 7, (("white", 30),), QUIET, robot=robot, scene=scene)
    return path


@pytest.fixture(scope="module")
def arm_recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return recorded_by_an_arm(tmp_path_factory.mktemp("arm") / "wall")


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


def test_lengths_of_links_are_found_or_named(tmp_path: Path) -> None:
    wall = recorded_by_an_arm(tmp_path / "wall", lengths_mm=LENGTHS)
    config = CONFIG | {"planes": "known", "split": {"test_fraction": 0.0}, "advice": 0}
    result = tofcorr.rig(wall, config, urdf=ArmOptions().file, length_tolerance_mm=1.0)
    joints, lengths = result.report["joints"], result.report["lengths"]
    for found, truth in ((joints, OFFSETS), (lengths, LENGTHS)):
        for one, true in zip(found, truth, strict=True):
            assert one["ci95"] is None or abs(one["offset"] - true) < 2 * one["ci95"]
    assert [one["joint"] for one in lengths if one["determined"]]
    same = {one["joint"]: one["same_as"] for one in lengths if one["ci95"] is None}
    # A wall that stands upright says nothing of the height of the base.
    assert same == {"pan z": "", "wrist_3 z": "a shift of the camera along it"}
    hardly = [one for one in lengths if one["ci95"] and not one["determined"]]
    assert ("hardly better known" in result.details) == bool(hardly)
    assert all(one["ci95"] > 1 for one in hardly)
    with pytest.raises(ConfigError, match="a tolerance of lengths needs a positive number, and"):
        tofcorr.rig(wall, config, length_tolerance_mm=1.0)


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
