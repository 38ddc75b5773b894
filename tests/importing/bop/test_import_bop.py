"""BOP scenes and BlenderProc's files become the recording of the same images and camera poses."""

import json
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from cameras import apart
from importing import scene_files
from importing.frames.imported import assert_equal_recordings, import_png, run_import
from importing.posed_scene import Drive, Recorded, unit_rays


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


def test_the_walls_speak_where_poses_are_not_those_of_the_camera(
    scene: Recorded, tmp_path: Path
) -> None:
    aside = np.eye(4)
    aside[:3, 3] = [0.12, -0.05, 0.03]
    shifted = replace(scene, exact=scene.exact @ aside)
    imported = run_import("bop", scene_files.write_bop(shifted, tmp_path / "s"), out=tmp_path / "o")
    assert "away from its poses" in imported.text
    found = np.array(imported.report["tool_from_camera"])
    assert apart(found, np.linalg.inv(aside))[0] < 20


def test_a_scene_without_poses_with_two_cameras_or_none_is_refused(
    scene: Recorded, tmp_path: Path
) -> None:
    few, out = scene.take(np.arange(3)), tmp_path / "out"
    bare = scene_files.write_bop(few, tmp_path / "bare", poses=False)
    assert "no image has a pose ('cam_R_w2c', 'cam_t_w2c')" in run_import("bop", bare, out=out).text
    folder = scene_files.write_bop(few, tmp_path / "scene")
    path = folder / "scene_camera.json"
    cameras = json.loads(path.read_text())
    cameras["1"]["cam_K"][0] = 99.0
    path.write_text(json.dumps(cameras))
    assert "'cam_K' of images 0 and 1 differ" in run_import("bop", folder, out=out).text
    path.unlink()
    assert "scene_camera.json: there is no such file" in run_import("bop", folder, out=out).text


def write_hdf5(scene: Recorded, folder: Path, key: str, *, poses: bool = True) -> Path:
    """Write files as BlenderProc does: metres, Blender's camera axes."""
    folder.mkdir()
    matrix = scene.matrix
    length = 1 / unit_rays(matrix, *scene.size)[..., 2]
    for number, (counts, pose) in enumerate(zip(scene.depth_mm, scene.exact, strict=True)):
        depth = np.where(counts > 0, counts / 1e3, 1e10)
        with h5py.File(folder / f"{number}.hdf5", "w") as file:
            file[key] = (depth * (length if key == "distance" else 1.0)).astype(np.float32)
            blender = pose @ np.diag([1.0, -1.0, -1.0, 1.0])
            if poses and number % 2:
                file["cam2world_matrix"] = blender
            elif poses:
                state = [{"cam2world_matrix": blender.tolist(), "cam_K": matrix.tolist()}]
                file["campose"] = np.bytes_(json.dumps(state))
    return folder


@pytest.mark.parametrize("key", ["depth", "distance"])
def test_files_of_blenderproc_give_the_same_poses_and_depth(
    key: str, scene: Recorded, tmp_path: Path
) -> None:
    imported = run_import("bop", write_hdf5(scene, tmp_path / "scene", key), out=tmp_path / "out")
    recording = imported.done
    assert recording.depth_kind == ("z" if key == "depth" else "radial")
    images = [int(frame["view"]) for frame in imported.report["views"]]
    poses = recording.frames.world_from_tool
    np.testing.assert_allclose(poses, scene.exact[images], rtol=0, atol=1e-6)
    seen = scene.depth_mm[images] > 0
    np.testing.assert_array_equal(np.isfinite(recording.depth), seen)
    if key == "depth":
        off = recording.depth - scene.depth_mm[images] / 1e3
        assert np.abs(off[seen]).max() < 1e-6


def test_files_without_pose_depth_or_sense_are_refused(scene: Recorded, tmp_path: Path) -> None:
    few, out = scene.take(np.arange(3)), tmp_path / "out"
    matrix = scene_files.write_intrinsics(scene, tmp_path / "camera.yaml")
    bare = write_hdf5(few, tmp_path / "bare", "depth", poses=False)
    refused = run_import("bop", bare, "--intrinsics", matrix, out=out)
    assert "no pose of the camera" in refused.text
    colour = write_hdf5(few, tmp_path / "colour", "colors")
    assert "expected 'depth' or 'distance'" in run_import("bop", colour, out=out).text
    (bare / "0.hdf5").write_bytes(b"no")
    assert "not a readable HDF5 file" in run_import("bop", bare, out=out).text
