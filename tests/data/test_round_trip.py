"""What is written is what is read, and what other tools write is read as well."""

import filecmp
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from broken_recordings import header
from optional import present
from small_recordings import (
    CAMERA,
    drawn_transform,
    frame_rows,
    small_images,
    write_small_recording,
)

from tofcorr.data.recording import Recording
from tofcorr.data.table import FrameRow
from tofcorr.data.writing import RecordingWriter, write_recording
from tofcorr.errors import CalibrationDataError
from tofcorr.geometry.camera import CameraIntrinsics, FrameNames

# A rotation goes through a quaternion and back: some units in the last place of float64.
ROUNDING = 1e-14


def copied(recording: Recording, path: Path) -> Recording:
    """Write a recording like another, of the same depth."""
    with RecordingWriter.like(path, recording) as writer:
        for depth in recording.depth:
            writer.append(depth, truth={"distance": 2.0 * depth})
    return Recording.open(path)


def test_every_part_survives_writing_and_opening(folder: Path) -> None:
    generator = np.random.default_rng(0)
    rows, tool_from_camera = frame_rows(generator), drawn_transform(generator)
    images, recording = small_images(generator), Recording.open(folder)
    assert (recording.camera, recording.depth_kind) == (CAMERA, "radial")
    assert (recording.modulation_frequency, recording.saturation_amplitude) == (20e6, 800.0)
    assert (recording.num_frames, recording.moves) == (len(rows), True)
    np.testing.assert_allclose(recording.tool_from_camera, tool_from_camera, atol=ROUNDING)
    for name, image in images.items():
        np.testing.assert_array_equal(getattr(recording, name), image)
    table = recording.frames
    for name in ("world_from_tool", "normal_world"):
        expected = np.stack([getattr(row, name) for row in rows])
        np.testing.assert_allclose(getattr(table, name), expected, atol=ROUNDING)
    for name in ("timestamp", "offset", "integration_time", "body_temperature"):
        expected = [getattr(row, name) for row in rows]
        np.testing.assert_allclose(getattr(table, name), expected, rtol=ROUNDING)
    assert table.target.tolist() == [row.target for row in rows]
    assert present(table.pose_id).tolist() == [str(row.pose_id) for row in rows]


def test_where_planes_come_from_and_the_names_of_frames_survive(tmp_path: Path) -> None:
    names = FrameNames(world="base_link", tool="tool0", camera="tof_optical")
    path = write_small_recording(tmp_path / "first", planes="estimated", frame_names=names)
    first = Recording.open(path)
    assert (first.planes, first.frame_names) == ("estimated", names)
    copy = copied(first, tmp_path / "copy")
    assert (copy.planes, copy.frame_names) == ("estimated", names)


def test_without_the_optional_keys_planes_are_recorded_and_names_usual(folder: Path) -> None:
    assert {"planes", "frames"}.isdisjoint(yaml.safe_load((folder / "recording.yaml").read_text()))
    recording = Recording.open(folder)
    assert (recording.planes, recording.frame_names) == ("recorded", FrameNames())
    header(("frames", {"world": "base_link"}))(folder)
    names = Recording.open(folder).frame_names
    assert (names.world, names.tool, names.camera) == ("base_link", "tool", "camera")


def test_what_is_optional_may_be_left_out_and_is_none(tmp_path: Path) -> None:
    rows = [replace(_without_optionals()[0], world_from_tool=np.eye(4))]
    depth = np.ones((1, CAMERA.height, CAMERA.width))
    write_recording(tmp_path / "bare", camera=CAMERA, depth_kind="z", rows=rows, depth=depth)
    recording = Recording.open(tmp_path / "bare")
    assert (recording.amplitude, recording.mask, recording.raw) == (None, None, None)
    assert (recording.modulation_frequency, recording.saturation_amplitude) == (None, None)
    table = recording.frames
    assert (table.pose_id, table.integration_time, table.ambient) == (None, None, None)
    np.testing.assert_array_equal(recording.tool_from_camera, np.eye(4))
    assert not recording.moves
    assert not (tmp_path / "bare" / "truth").exists()


def test_truth_is_written_apart(tmp_path: Path, folder: Path) -> None:
    copy = copied(Recording.open(folder), tmp_path / "copy")
    truth = np.load(copy.path / "truth" / "distance.npy")
    np.testing.assert_array_equal(truth, 2.0 * copy.depth)


def test_a_recording_like_another_has_its_very_rows(tmp_path: Path, folder: Path) -> None:
    table = (folder / "frames.csv").read_text().splitlines()
    extended = [f"{line},{'serial' if i == 0 else 'A7'}" for i, line in enumerate(table)]
    (folder / "frames.csv").write_text("\r\n".join(extended))
    recording = Recording.open(folder)
    copy = copied(recording, tmp_path / "copy")
    assert filecmp.cmp(folder / "frames.csv", tmp_path / "copy" / "frames.csv", shallow=False)
    np.testing.assert_array_equal(copy.tool_from_camera, recording.tool_from_camera)
    assert copy.camera == recording.camera


def test_a_frequency_without_a_sign_in_its_exponent_is_a_number(folder: Path) -> None:
    # YAML 1.1 reads 20.0e6 as text; the format's own example writes it so.
    header(("modulation_frequency_hz", 0))(folder)
    path = folder / "recording.yaml"
    path.write_text(path.read_text().replace("frequency_hz: 0", "frequency_hz: 20.0e6"))
    assert Recording.open(folder).modulation_frequency == 20e6


def test_a_rounded_hand_eye_becomes_an_exact_rotation(folder: Path) -> None:
    rounded = np.round(Recording.open(folder).tool_from_camera, 4)
    header(("tool_from_camera", rounded.tolist()))(folder)
    rotation = Recording.open(folder).tool_from_camera[:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(rotation, rounded[:3, :3], atol=2e-4)


def test_require_names_the_missing_part_and_what_needs_it(tmp_path: Path, folder: Path) -> None:
    recording = Recording.open(folder)
    assert recording.require("amplitude", "I1") is recording.amplitude
    said = r"frames.csv: column 'ambient' is empty for frame 1; the ambient effect needs it"
    with pytest.raises(CalibrationDataError, match=said):
        recording.require("ambient", "the ambient effect")
    bare = write_small_recording(
        tmp_path / "bare", amplitude=None, modulation_frequency=None, rows=_without_optionals()
    )
    recording = Recording.open(bare)
    for name, message in {
        "amplitude": "amplitude.npy is missing; the intensity term I1 needs it",
        "modulation_frequency": "'modulation_frequency_hz' is missing; the intensity term I1",
        "integration_time": "column 'integration_time_us' is missing",
        "pose_id": "column 'pose_id' is missing",
    }.items():
        with pytest.raises(CalibrationDataError, match=message):
            recording.require(name, "the intensity term I1")


@pytest.mark.parametrize("length", [0, 4, 5, 8, 12, 14])
def test_every_distortion_model_of_opencv_is_taken(tmp_path: Path, length: int) -> None:
    camera = CameraIntrinsics(width=7, height=5, matrix=CAMERA.matrix, distortion=(0.01,) * length)
    path = write_small_recording(tmp_path / "recording", camera=camera)
    assert Recording.open(path).camera == camera


def _without_optionals() -> list[FrameRow]:
    kept = ("timestamp", "world_from_tool", "normal_world", "offset", "target")
    rows = frame_rows(np.random.default_rng(0))
    return [FrameRow(**{name: getattr(row, name) for name in kept}) for row in rows]
