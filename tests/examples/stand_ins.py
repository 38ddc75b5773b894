"""Stand-ins for rclpy, tf2_ros, messages and camera drivers: as much as the examples use."""

import sys
from array import array
from dataclasses import dataclass, field
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any, ClassVar

from optional import present

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"


@dataclass
class Stamp:
    sec: int = 0
    nanosec: int = 0


@dataclass
class Header:
    stamp: Stamp = field(default_factory=Stamp)
    frame_id: str = ""


class _Message:
    """A message of rosidl: its fields are fixed, have types, and are given by keyword."""

    fields_of: ClassVar[dict[str, type]] = {}

    def __init__(self, **values: Any) -> None:
        for name, kind in self.fields_of.items():
            object.__setattr__(self, name, array("B") if kind is array else kind())
        for name, value in values.items():
            setattr(self, name, value)

    def __setattr__(self, name: str, value: Any) -> None:
        if name not in self.fields_of:
            raise AttributeError(f"{type(self).__name__} has no field {name}")
        kind = self.fields_of[name]
        assert isinstance(value, kind), f"{name} must be {kind.__name__}, got {type(value)}"
        if kind is array:
            assert value.typecode == "B"
        object.__setattr__(self, name, value)


_SIZE = {"header": Header, "height": int, "width": int}


class Image(_Message):
    fields_of: ClassVar = _SIZE | {"encoding": str, "is_bigendian": int, "step": int, "data": array}


class PointField(_Message):
    FLOAT32 = 7
    fields_of: ClassVar = {"name": str, "offset": int, "datatype": int, "count": int}


class PointCloud2(_Message):
    fields_of: ClassVar = {
        **(_SIZE | {"fields": list, "data": array}),
        "is_bigendian": bool,
        "is_dense": bool,
        "point_step": int,
        "row_step": int,
    }


class CameraInfo(_Message):
    fields_of: ClassVar = {**_SIZE, "k": list, "d": list, "distortion_model": str}


class String(_Message):
    fields_of: ClassVar = {"data": str}


class Point(_Message):
    fields_of: ClassVar = dict.fromkeys("xyz", float)


class Quaternion(_Message):
    fields_of: ClassVar = dict.fromkeys("xyzw", float)


class Pose(_Message):
    fields_of: ClassVar = {"position": Point, "orientation": Quaternion}


class PoseStamped(_Message):
    fields_of: ClassVar = {"header": Header, "pose": Pose}


class TransformException(Exception):  # noqa: N818 - so it is called
    """What tf2_ros raises where frames are not connected."""


class Buffer:
    """Knows the transforms of `poses`, by target and source."""

    poses: ClassVar[dict[tuple[str, str], Any]] = {}

    def lookup_transform(self, target: str, source: str, time: Any) -> Any:
        assert time is not None
        if (target, source) not in self.poses:
            raise TransformException(f"'{source}' is not connected with '{target}'")
        x, y, z, *turn = self.poses[target, source]
        rotation = SimpleNamespace(**dict(zip("xyzw", turn, strict=True)))
        translation = SimpleNamespace(x=x, y=y, z=z)
        return SimpleNamespace(
            transform=SimpleNamespace(translation=translation, rotation=rotation)
        )


@dataclass
class Publisher:
    """Keeps what is published."""

    kind: type
    topic: str
    subscribers: int = 0
    messages: list[Any] = field(default_factory=list)

    def publish(self, message: Any) -> None:
        assert type(message) is self.kind
        self.messages.append(message)

    def get_subscription_count(self) -> int:
        return self.subscribers


class Node:
    """Has the parameters of `parameters`; keeps publishers, subscriptions and log lines."""

    parameters: ClassVar[dict[str, Any]] = {}

    def __init__(self, name: str) -> None:
        self.name = name
        self.subscriptions_by_topic: dict[str, tuple[type, Any]] = {}
        self.publishers_by_topic: dict[str, Publisher] = {}
        self.log: dict[str, list[str]] = {"info": [], "error": []}
        self.timers: list[Any] = []

    def declare_parameter(self, name: str, default: Any) -> Any:
        return SimpleNamespace(value=self.parameters.get(name, default))

    def create_publisher(self, kind: type, topic: str, qos: int) -> Publisher:
        assert qos
        self.publishers_by_topic[topic] = Publisher(kind, topic)
        return self.publishers_by_topic[topic]

    def create_subscription(self, kind: type, topic: str, callback: Any, qos: Any) -> None:
        assert qos
        self.subscriptions_by_topic[topic] = (kind, callback)

    def create_timer(self, period: float, callback: Any) -> None:
        assert period > 0
        self.timers.append(callback)

    def get_logger(self) -> Any:
        return SimpleNamespace(info=self.log["info"].append, error=self.log["error"].append)

    def receive(self, topic: str, message: Any) -> None:
        """Give a message to the subscription of a topic."""
        kind, callback = self.subscriptions_by_topic[topic]
        assert type(message) is kind
        callback(message)


def ros_modules() -> dict[str, ModuleType]:
    """Return the modules that the node imports, by name."""
    names = ("rclpy", "rclpy.node", "rclpy.qos", "sensor_msgs", "sensor_msgs.msg")
    names += ("std_msgs", "std_msgs.msg", "geometry_msgs", "geometry_msgs.msg")
    names += ("tf2_ros", "rclpy.time")
    modules: dict[str, Any] = {name: ModuleType(name) for name in names}
    modules["rclpy.node"].Node = Node
    modules["rclpy.qos"].qos_profile_sensor_data = object()
    modules["rclpy.time"].Time = object
    modules["std_msgs.msg"].Header = Header
    modules["std_msgs.msg"].String = String
    modules["geometry_msgs.msg"].PoseStamped = PoseStamped
    modules["tf2_ros"].Buffer = Buffer
    modules["tf2_ros"].TransformException = TransformException
    modules["tf2_ros"].TransformListener = lambda buffer, node: (buffer, node)
    for message in (Image, PointField, PointCloud2, CameraInfo):
        setattr(modules["sensor_msgs.msg"], message.__name__, message)
    return modules


def load_example(name: str) -> Any:
    """Import a file of `examples/` as a module of its own."""
    spec = present(spec_from_file_location(f"example_{name}", EXAMPLES / f"{name}.py"))
    module = module_from_spec(spec)
    sys.modules[spec.name] = module
    present(spec.loader).exec_module(module)
    return module
