"""BOP scenes become the recording of the same images and camera poses."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cameras import apart, rigid
from importing import scene_files
from importing.frames.imported import assert_equal_recordings, import_png, run_import
from importing.posed_scene import Drive, Recorded
from scipy.spatial.transform import Rotation


@pytest.fixture(scope="module")
def scene() -> Recorded:
    """A camera that is the tool itself, without lens distortion, as renderers have it."""
    drive = Drive(stops=20, width=32, height=24, distortion=(), tool_from_camera=np.eye(4), rate=4)
    recorded = drive.record().one_a_stop()
    return replace(recorded, pose_times=recorded.image_times, world_from_tool=recorded.exact)


def test_a_bop_scene_gives_the_recording_of_the_same_images_and_poses_in_files(
    scene: Recorded, tmp_path: Path
) -> None:
    folder = scene_files.write_bop(scene, tmp_path / "scene")
    imported = run_import("bop", folder, "--amplitude", "gray/*.png", out=tmp_path / "out")
    from_files = import_png(scene, tmp_path / "files")
    assert_equal_recordings(from_files.done, imported.done, 1e-7)
    # The tool is the camera: no hand-eye transform has to be guessed.
    np.testing.assert_array_equal(imported.done.tool_from_camera, np.eye(4))
    assert imported.report["paired_by"] == "name"


def test_the_walls_speak_where_poses_are_of_another_frame(scene: Recorded, tmp_path: Path) -> None:
    aside = rigid(Rotation.identity(), [0.12, -0.05, 0.03])
    shifted = replace(scene, exact=scene.exact @ aside)
    imported = run_import("bop", scene_files.write_bop(shifted, tmp_path / "s"), out=tmp_path / "o")
    assert "away from its poses" in imported.text
    found = np.array(imported.report["tool_from_camera"])
    assert apart(found, np.linalg.inv(aside))[0] < 20


def test_a_scene_without_poses_or_one_camera_is_refused(scene: Recorded, tmp_path: Path) -> None:
    few, out = scene.take(np.arange(3)), tmp_path / "out"
    bare = scene_files.write_bop(few, tmp_path / "bare", poses=False)
    assert "no image has a pose ('cam_R_w2c', 'cam_t_w2c')" in run_import("bop", bare, out=out).text
    folder = scene_files.write_bop(few, tmp_path / "scene")
    path = folder / "scene_camera.json"
    cameras = json.loads(path.read_text())
    cameras["1"]["cam_K"][0] = 99.0
    path.write_text(json.dumps(cameras))
    assert "'cam_K' or 'depth_scale' of 3 images differ" in run_import("bop", folder, out=out).text
    path.unlink()
    assert "scene_camera.json: there is no such file" in run_import("bop", folder, out=out).text
