"""The calibrator of the ROS 2 package learns where robots stop, run against stand-ins for ROS."""

import json
import sys
from array import array
from collections.abc import Iterator
from http.client import HTTPConnection
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from examples.stand_ins import (
    EXAMPLES,
    Buffer,
    CameraInfo,
    Header,
    Image,
    Node,
    Stamp,
    ros_modules,
)
from scipy.spatial.transform import Rotation
from simulated_walls import simulated_wall

import tofcorr
from tofcorr.geometry.camera import CameraSection

BASE, TOOL, CAMERA = "base_link", "tool0", "tof"


def seven(pose: np.ndarray) -> list[float]:
    return [*pose[:3, 3], *Rotation.from_matrix(pose[:3, :3]).as_quat()]


@pytest.fixture(scope="module")
def wall(tmp_path_factory: pytest.TempPathFactory) -> tofcorr.Recording:
    folder = tmp_path_factory.mktemp("ros") / "wall"
    simulated_wall(folder, shots=(("white", 12),))
    return tofcorr.Recording.open(folder)


@pytest.fixture
def node(wall: tofcorr.Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    for name, module in ros_modules().items():
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.syspath_prepend(str(EXAMPLES / "ros2"))
    given = {"port": 0, "depth_kind": wall.depth_kind, "wanted_mm": 50.0, "wanted_deg": 5.0}
    given |= {"folder": str(tmp_path / "live"), "model": str(tmp_path / "corrector.ts")}
    monkeypatch.setattr(Node, "parameters", given)
    monkeypatch.setattr(Buffer, "poses", {(TOOL, CAMERA): seven(wall.tool_from_camera)})
    made = import_module("tofcorr_ros.calibrator").Calibrator()
    yield made
    made.server.shutdown()
    made.server.server_close()
    for name in [name for name in sys.modules if name.startswith("tofcorr_ros")]:
        del sys.modules[name]


def message(values: np.ndarray, time: float) -> Image:
    header = Header(stamp=Stamp(int(time), round(time % 1 * 10**9)), frame_id=CAMERA)
    height, width = values.shape
    content = array("B", values.astype("<f4").tobytes())
    fields = {"header": header, "height": height, "width": width, "step": 4 * width}
    return Image(encoding="32FC1", data=content, **fields)


def drive(node: Any, wall: tofcorr.Recording, frames: range) -> None:
    """Stop for two seconds at the pose of each frame, with two images a second on the way."""
    camera: CameraSection = wall.header.camera
    lens = {"k": list(np.ravel(camera.K)), "d": list(camera.distortion)}
    size = {"width": camera.width, "height": camera.height, "distortion_model": "plumb_bob"}
    node.receive("depth/camera_info", CameraInfo(**lens, **size))
    assert wall.amplitude is not None
    for frame in frames:
        for k in range(6):
            pose = wall.frames.world_from_tool[frame].copy()
            pose[2, 3] += 0.01 * max(0, 2 - k)
            Buffer.poses[BASE, TOOL] = seven(pose)
            time = 100.0 + 3 * frame + k / 2
            node.receive("depth/image_raw", message(wall.depth[frame], time))
            node.receive("infrared/image_raw", message(wall.amplitude[frame], time))


def test_it_learns_one_frame_of_each_stop_and_says_where_to_stand_next(
    node: Any, wall: tofcorr.Recording, tmp_path: Path
) -> None:
    drive(node, wall, range(12))
    assert node.log["error"] == []
    live = tofcorr.LiveCalibration.resume(tmp_path / "live")
    taken = np.stack([one.row.world_from_tool for one in live.frames])
    np.testing.assert_allclose(taken, wall.frames.world_from_tool[:12], atol=1e-9)
    said = [one.data for one in node.publishers_by_topic["known"].messages]
    assert said[-1].startswith("12 poses: the hand-eye transform is known to")
    pose = node.publishers_by_topic["next_pose"].messages[-1]
    wanted = node.calibrating.live.next_pose()
    place, turn = pose.pose.position, pose.pose.orientation
    found = [place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w]
    np.testing.assert_allclose(found, seven(wanted))
    assert (pose.header.frame_id, pose.header.stamp.sec) == (BASE, 135)
    model = tofcorr.load_corrector(tmp_path / "corrector.ts")
    assert json.loads(model.metadata())["camera"]["width"] == wall.camera.width
    connection = HTTPConnection("127.0.0.1", node.server.server_port, timeout=20)
    connection.request("GET", "/events")
    line = connection.getresponse().readline()
    connection.close()
    assert json.loads(line.removeprefix(b"data: "))["verdict"] == said[-1].partition("\n")[0]


def test_an_image_that_cannot_be_used_is_named_and_the_next_one_taken(
    node: Any, wall: tofcorr.Recording, tmp_path: Path
) -> None:
    drive(node, wall, range(2))
    before = wall.depth[2]
    wrong = np.where(np.indices(before.shape).sum(axis=0) % 2, before, 2 * before)
    assert wall.amplitude is not None
    for time in (200.0, 201.5):
        Buffer.poses[BASE, TOOL] = seven(wall.frames.world_from_tool[5])
        node.receive("depth/image_raw", message(wrong[:10], time))
        node.receive("infrared/image_raw", message(wall.amplitude[2][:10], time))
    del Buffer.poses[BASE, TOOL]
    node.receive("depth/image_raw", message(before, 210.0))
    node.receive("infrared/image_raw", message(wall.amplitude[2], 210.0))
    drive(node, wall, range(40, 40))
    size, tf = node.log["error"]
    assert "camera_info says" in size
    assert "'tool0' is not connected with 'base_link'" in tf
    assert len(tofcorr.LiveCalibration.resume(tmp_path / "live")) == 2
    assert [one[:23] for one in node.page.state["said"]] == ["An image was left out: "] * 2
