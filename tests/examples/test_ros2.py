"""The ROS 2 node publishes what the corrector gives, run against stand-ins for ROS."""

import sys
from array import array
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from examples.correctors import HEIGHT, WIDTH, frame, save_corrector
from examples.stand_ins import EXAMPLES, CameraInfo, Header, Image, Node, Stamp, ros_modules

from tofcorr.error_terms.model import ErrorModelOptions

PACKAGE = EXAMPLES / "ros2"
STAMP = Header(stamp=Stamp(12, 345_000_000), frame_id="tof_optical_frame")


@pytest.fixture
def node_class(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[], Any]]:
    for name, module in ros_modules().items():
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.syspath_prepend(str(PACKAGE))
    yield import_module("tofcorr_ros.node").DepthCorrector
    for name in [name for name in sys.modules if name.startswith("tofcorr_ros")]:
        del sys.modules[name]


@pytest.fixture
def start(
    node_class: Callable[[], Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Callable[..., Any]:
    def run(changed: dict[str, Any] | None = None, **parameters: Any) -> Any:
        model = save_corrector(tmp_path / "corrector.ts", **(changed or {}))
        monkeypatch.setattr(Node, "parameters", {"model": str(model), **parameters})
        return node_class()

    return run


def image(values: np.ndarray, encoding: str, stamp: Header = STAMP, **changed: Any) -> Image:
    """Return a message of an image, rows without padding."""
    fields = {
        "header": stamp,
        "height": values.shape[0],
        "width": values.shape[1],
        "encoding": encoding,
        "step": values.shape[1] * values.itemsize,
        "data": array("B", values.tobytes()),
    }
    return Image(**(fields | changed))


def expected(tmp_path: Path, depth: np.ndarray, amplitude: np.ndarray) -> tuple[Any, Any, Any]:
    """Return corrected depth, validity and points of the corrector itself."""
    corrector = torch.jit.load(str(tmp_path / "corrector.ts"))
    metres = torch.from_numpy(depth.astype(np.float32) * np.float32(1e-3))
    given = metres, torch.from_numpy(amplitude.astype(np.float32))
    corrected, valid = corrector(*given)
    return corrected.numpy(), valid.numpy(), corrector.points(*given).numpy()


def give(node: Any, depth: np.ndarray, amplitude: np.ndarray) -> None:
    node.receive("depth/image_raw", image(depth, "16UC1"))
    node.receive("infrared/image_raw", image(amplitude, "mono16"))


def published(node: Any, topic: str = "depth/image_corrected") -> list[Any]:
    return node.publishers_by_topic[topic].messages


def pixels(message: Image) -> np.ndarray:
    assert (message.encoding, message.step) == ("32FC1", 4 * message.width)  # type: ignore[attr-defined]
    size = (message.height, message.width)  # type: ignore[attr-defined]
    return np.frombuffer(message.data, "<f4").reshape(size)  # type: ignore[attr-defined]


def padded(message: Image, padding: int) -> Image:
    """Return the same image with bytes behind each row, as drivers align them."""
    rows = np.frombuffer(message.data, np.uint8).reshape(message.height, -1)  # type: ignore[attr-defined]
    wide = np.pad(rows, ((0, 0), (0, padding)), constant_values=255)
    message.step, message.data = wide.shape[1], array("B", wide.tobytes())
    return message


def test_it_publishes_what_the_corrector_gives(start: Callable[..., Any], tmp_path: Path) -> None:
    node = start()
    node.publishers_by_topic["points_corrected"].subscribers = 1
    depth, amplitude = frame()
    node.receive("depth/image_raw", image(depth, "16UC1"))
    assert published(node) == []
    node.receive("infrared/image_raw", image(amplitude, "mono16"))
    corrected, _, points = expected(tmp_path, depth, amplitude)
    (message,) = published(node)
    np.testing.assert_array_equal(pixels(message), corrected)
    assert message.header == STAMP
    assert np.isnan(pixels(message)[1, 2])
    (cloud,) = published(node, "points_corrected")
    places = [(f.name, f.offset, f.datatype) for f in cloud.fields]
    assert places == [("x", 0, 7), ("y", 4, 7), ("z", 8, 7)]
    assert (cloud.height, cloud.width, cloud.row_step) == (HEIGHT, WIDTH, 12 * WIDTH)
    found = np.frombuffer(cloud.data, "<f4").reshape(HEIGHT, WIDTH, 3)
    np.testing.assert_array_equal(found, points)
    assert node.log["error"] == []


@pytest.mark.parametrize(
    "made",
    [
        lambda depth: image(depth.astype(">u2"), "16UC1", is_bigendian=1),
        lambda depth: padded(image(depth, "16UC1"), 6),
        lambda depth: padded(image(depth, "mono16"), 3),
        lambda depth: image(depth * np.float32(1e-3), "32FC1"),
        lambda depth: image((depth * np.float32(1e-3)).astype(">f4"), "32FC1", is_bigendian=1),
    ],
    ids=["big-endian", "padded rows", "odd padding", "metres", "big-endian metres"],
)
def test_the_same_depth_in_another_coding_gives_the_same_result(
    made: Callable[[np.ndarray], Image], start: Callable[..., Any], tmp_path: Path
) -> None:
    node = start()
    depth, amplitude = frame()
    node.receive("depth/image_raw", made(depth))
    node.receive("infrared/image_raw", image(amplitude.astype(np.float32), "32FC1"))
    corrected, _, _ = expected(tmp_path, depth, amplitude)
    np.testing.assert_array_equal(pixels(published(node)[0]), corrected)


def test_only_valid_pixels_remain_if_asked(start: Callable[..., Any], tmp_path: Path) -> None:
    node = start(only_valid=True)
    give(node, *frame())
    corrected, valid, _ = expected(tmp_path, *frame())
    assert not valid.all()
    kept = np.where(valid, corrected, np.float32(np.nan))
    np.testing.assert_array_equal(pixels(published(node)[0]), kept)
    # Points are computed only for those who listen.
    assert published(node, "points_corrected") == []


def test_images_of_one_exposure_find_each_other_in_any_order(
    start: Callable[..., Any], tmp_path: Path
) -> None:
    node = start()
    headers = [Header(stamp=Stamp(1, 33_000_000 * k)) for k in range(4)]
    frames = [frame(seed) for seed in range(4)]
    # Infrared of frame 1 is lost; that of frames 2 and 3 comes before their depth.
    for kind, k in (("d", 0), ("d", 1), ("i", 0), ("i", 2), ("i", 3), ("d", 2), ("d", 3)):
        topic = "depth/image_raw" if kind == "d" else "infrared/image_raw"
        values, encoding = (frames[k][0], "16UC1") if kind == "d" else (frames[k][1], "mono16")
        node.receive(topic, image(values, encoding, headers[k]))
    assert [message.header for message in published(node)] == [headers[k] for k in (0, 2, 3)]
    for message, k in zip(published(node), (0, 2, 3), strict=True):
        np.testing.assert_array_equal(pixels(message), expected(tmp_path, *frames[k])[0])


def test_missing_infrared_is_said_once(start: Callable[..., Any]) -> None:
    node = start()
    depth, _ = frame()
    for k in range(100):
        node.receive("depth/image_raw", image(depth, "16UC1", Header(stamp=Stamp(k))))
    (line,) = node.log["error"]
    assert "30 depth images and no infrared image" in line
    assert "remapped" in line
    assert published(node) == []


def test_a_model_without_amplitude_subscribes_to_depth_alone(start: Callable[..., Any]) -> None:
    terms = [{"kind": "distance_polynomial"}, {"kind": "pixel_polynomial"}]
    model = ErrorModelOptions.from_mapping({"terms": terms}, "test")
    coefficients = torch.linspace(-0.02, 0.03, 8, dtype=torch.float64)
    node = start({"error_model": model, "coefficients": coefficients})
    assert "infrared/image_raw" not in node.subscriptions_by_topic
    node.receive("depth/image_raw", image(frame()[0], "16UC1"))
    assert np.isfinite(pixels(published(node)[0])).sum() == HEIGHT * WIDTH - 1


@pytest.mark.parametrize(
    ("message", "said"),
    [
        (image(np.ones((5, 6), np.uint16), "16UC1"), "has 6x5 pixels, the model EA is for 7x5"),
        (image(np.ones((5, 7, 3), np.uint8), "rgb8"), "encoding 'rgb8': one of 16UC1"),
        (image(np.ones((5, 7), np.uint8), "mono8"), "16UC1 in millimetres or 32FC1 in metres"),
        (image(np.ones((5, 7), np.uint16), "16UC1", data=array("B", b"12")), "sizes contradict"),
    ],
    ids=["size", "colour", "8-bit depth", "truncated"],
)
def test_an_image_of_another_kind_is_named_once_and_left_out(
    message: Image, said: str, start: Callable[..., Any]
) -> None:
    node = start()
    for _ in range(3):
        node.receive("depth/image_raw", message)
        node.receive("infrared/image_raw", image(frame()[1], "mono16"))
    (line,) = node.log["error"]
    assert line.startswith("Not corrected: ")
    assert said in line
    assert published(node) == []


def test_another_lens_calibration_is_remarked_upon(start: Callable[..., Any]) -> None:
    node = start()
    for focal, errors in ((9.0, 0), (9.4, 1), (9.4, 1)):
        info = CameraInfo(k=[focal, 0.0, 3.2, 0.0, 9.5, 1.9, 0.0, 0.0, 1.0])
        node.receive("depth/camera_info", info)
        assert len(node.log["error"]) == errors
    (line,) = node.log["error"]
    assert "[9.4, 9.5, 3.2, 1.9]" in line
    assert "[9.0, 9.5, 3.2, 1.9]" in line


def test_a_new_model_is_taken_over_and_a_damaged_one_is_not(
    start: Callable[..., Any], tmp_path: Path
) -> None:
    node = start()
    (look,) = node.timers
    before = expected(tmp_path, *frame())[0]
    give(node, *frame())
    model = tmp_path / "corrector.ts"
    save_corrector(tmp_path / "next.ts", coefficients=torch.full((10,), 0.01).double())
    (tmp_path / "next.ts").replace(model)
    look()
    give(node, *frame())
    after = expected(tmp_path, *frame())[0]
    (tmp_path / "bad.ts").write_bytes(b"no model")
    (tmp_path / "bad.ts").replace(model)
    look()
    look()
    give(node, *frame())
    assert not np.array_equal(before, after, equal_nan=True)
    for message, wanted in zip(published(node), (before, after, after), strict=True):
        np.testing.assert_array_equal(pixels(message), wanted)
    (line,) = node.log["error"]
    assert line.startswith("No new model in")


def test_a_model_that_is_not_there_yet_is_waited_for(
    start: Callable[..., Any], tmp_path: Path
) -> None:
    node = start(model=str(tmp_path / "later.ts"))
    node.receive("depth/image_raw", image(frame()[0], "16UC1"))
    assert published(node) == []
    save_corrector(tmp_path / "later.ts")
    node.timers[0]()
    give(node, *frame())
    assert len(published(node)) == 1
