"""Bags of ROS 1 and ROS 2 become the recording that files of the same drive become."""

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from importing.frames.imported import Imported, assert_equal_recordings, run_import
from importing.posed_scene import Recorded
from importing.rosbag import written_bags

from tofcorr.examples import bags


def import_bag(path: Path, out: Path, *arguments: object, depth: str = bags.DEPTH) -> Imported:
    """Import a bag, with the frames and the infrared topic of `write_drive`."""
    frames = ("--base-frame", bags.BASE, "--tool-frame", bags.TOOL)
    return run_import("rosbag", path, "--depth", depth, *frames, *arguments, out=out)


WITH_INFRARED = ("--amplitude", bags.INFRARED)


def written(
    recorded: Recorded, folder: Path, write: Callable[[bags.Bag, float, np.ndarray], None]
) -> Path:
    """Write a bag whose depth images are written in a way of their own."""
    path = written_bags.bag_path(folder, "mcap")
    with bags.writing(path, "mcap") as bag:
        bag.camera_info(bags.INFO, recorded)
        written_bags.write_robot(bag, recorded)
        for time, depth in zip(recorded.image_times, recorded.depth_mm, strict=True):
            write(bag, time, depth)
    return path


@pytest.mark.parametrize("kind", written_bags.KINDS)
def test_a_bag_of_any_kind_gives_the_recording_of_the_same_drive_in_files(
    kind: str, at_stops: Recorded, from_files: Imported, tmp_path: Path
) -> None:
    path = written_bags.write_drive(at_stops, tmp_path, kind)
    imported = import_bag(path, tmp_path / "out", *WITH_INFRARED)
    assert_equal_recordings(from_files.done, imported.done, 0.0)
    assert imported.done.frame_names.camera == bags.CAMERA
    assert imported.done.camera.distortion == at_stops.distortion
    for file in path.glob("*.mcap"):  # A file of a ROS 2 folder.
        assert import_bag(file, tmp_path / "alone").done.amplitude is None


@pytest.mark.parametrize("coding", ["16UC1", "32FC1", "big-endian", "metres"])
def test_depth_is_the_same_however_its_messages_are_coded(
    coding: str, at_stops: Recorded, tmp_path: Path
) -> None:
    def write(bag: bags.Bag, time: float, depth: np.ndarray) -> None:
        if coding == "big-endian":
            bag.image(bags.DEPTH, time, depth, "16UC1", big_endian=True)
        elif coding == "metres":
            bag.image(bags.DEPTH, time, (depth / 1e3).astype(np.float32), "32FC1")
        else:
            content = written_bags.compressed_depth(depth, floats=coding == "32FC1")
            written_bags.write_compressed(bag, time, content, f"{coding}; compressedDepth png")

    path = written(at_stops, tmp_path, write)
    imported = import_bag(path, tmp_path / "out")
    recording = imported.done
    places = {f"{time:.6f}": k for k, time in enumerate(at_stops.image_times)}
    exact = at_stops.depth_mm[[places[frame["view"]] for frame in imported.report["views"]]] / 1e3
    # The inverse depth of compressedDepth is rounded: d^2 / (2 * 10 100) is 0.2 mm at 2 m.
    quantum = 1.01 * exact**2 / (2 * 10_100) + 1e-6 if coding == "32FC1" else 1e-6
    seen = exact > 0
    np.testing.assert_array_equal(np.isfinite(recording.depth), seen)
    assert (np.abs(recording.depth - exact) <= quantum)[seen].all()


def test_stamps_of_headers_count_and_receipt_is_named_where_there_are_none(
    at_stops: Recorded, tmp_path: Path
) -> None:
    def write(bag: bags.Bag, time: float, depth: np.ndarray) -> None:
        bag.header = lambda time, frame=bags.CAMERA: type(bag).header(bag, 0.0, frame)
        bag.image(bags.DEPTH, time, depth, "16UC1")
        del bag.header

    path = written(at_stops, tmp_path, write)
    imported = import_bag(path, tmp_path / "out")
    assert "hold no time stamps" in imported.text
    assert imported.report["views"][0]["timestamp_s"] > 1000


def test_a_missing_topic_is_named_with_those_there_are(at_stops: Recorded, tmp_path: Path) -> None:
    path = written_bags.write_drive(at_stops.take(np.arange(3)), tmp_path, "mcap")
    out = tmp_path / "out"
    missing = import_bag(path, out, depth="/nope").refusal
    assert "there is no such topic" in missing
    assert f"{bags.DEPTH} (sensor_msgs/Image)" in missing
    wrong = import_bag(path, out, depth=bags.INFO).refusal
    assert "it is sensor_msgs/CameraInfo" in wrong
    wrong = import_bag(path, out, "--camera-info", bags.DEPTH).refusal
    assert "expected sensor_msgs/CameraInfo, it is sensor_msgs/Image" in wrong


def test_a_missing_frame_or_transform_is_named(at_stops: Recorded, tmp_path: Path) -> None:
    path = written_bags.write_drive(at_stops.take(np.arange(3)), tmp_path, "mcap")

    def between(base: str, tool: str) -> str:
        frames = ("--base-frame", base, "--tool-frame", tool)
        return import_bag(path, tmp_path / "out", *frames).text

    unknown = between(bags.BASE, "hand")
    assert "no frame 'hand'" in unknown
    assert "base_link, shoulder, tool0, world, wrist" in unknown
    assert "static" in between(bags.TOOL, "wrist")
    bare = written_bags.bag_path(tmp_path / "bare", "mcap")
    with bags.writing(bare, "mcap") as bag:
        bag.camera_info(bags.INFO, at_stops)
        bag.image(bags.DEPTH, at_stops.image_times[0], at_stops.depth_mm[0], "16UC1")
    assert "no topic holds transforms" in import_bag(bare, tmp_path / "out").text


@pytest.mark.parametrize(
    ("encoding", "said"),
    [("mono8", "'mono8'; expected one channel of 16 bits"), ("rgb8", "has encoding 'rgb8'")],
)
def test_previews_are_refused(at_stops: Recorded, tmp_path: Path, encoding: str, said: str) -> None:
    def write(bag: bags.Bag, time: float, depth: np.ndarray) -> None:
        bag.image(bags.DEPTH, time, (depth // 20).astype(np.uint8), encoding)

    path = written(at_stops, tmp_path, write)
    assert said in import_bag(path, tmp_path / "out").refusal


@pytest.mark.parametrize(
    ("model", "known", "said"),
    [
        ("equidistant", 1.0, "equidistant"),
        (None, 1.0, "no topic holds camera intrinsics"),
        ("plumb_bob", 0.0, "holds K of zeros"),
    ],
)
def test_a_fisheye_lens_and_a_camera_that_is_missing_or_unknown_are_refused(
    model: str | None, known: float, said: str, at_stops: Recorded, tmp_path: Path
) -> None:
    path = written_bags.bag_path(tmp_path, "mcap")
    with bags.writing(path, "mcap") as bag:
        bag.image(bags.DEPTH, at_stops.image_times[0], at_stops.depth_mm[0], "16UC1")
        if model:
            camera = replace(at_stops, matrix=known * at_stops.matrix)
            bag.camera_info(bags.INFO, camera, model)
    assert said in import_bag(path, tmp_path / "out").refusal


def test_no_bag_and_no_package_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text, out = tmp_path / "text.bag", tmp_path / "out"
    assert "no such bag" in import_bag(text, out).refusal
    text.write_text("hello")
    assert "not a readable ROS bag" in import_bag(text, out).refusal
    monkeypatch.setitem(sys.modules, "rosbags", None)
    assert "pip install 'tofcorr[rosbag]'" in import_bag(text, out).refusal
