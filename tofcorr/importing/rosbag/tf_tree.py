"""The robot's transforms in a bag: from base to tool over all hops, moving and static."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch

from tofcorr.errors import CalibrationDataError
from tofcorr.geometry import se3
from tofcorr.importing.pose_files import pose_from_quaternion
from tofcorr.importing.pose_track import PoseTrack
from tofcorr.importing.rosbag.bag import Bag


@dataclass
class Edge:
    """The transforms that one frame had in its parent.

    Attributes:
        parent: The parent's name.
        static: Whether it holds for all times.
        times: Seconds.
        poses: Each parent_from_child, shape (4, 4).
    """

    parent: str
    static: bool
    times: list[float] = field(default_factory=list)
    poses: list[np.ndarray] = field(default_factory=list)


def read_tf(bag: Bag) -> dict[str, Edge]:
    """Read all transforms of a bag, by the child's name.

    Raises:
        CalibrationDataError: There are none, one is not rigid, or a frame has two parents.
    """
    kinds = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
    topics = [topic for topic, kind in bag.types.items() if kind in kinds]
    if not topics:
        raise CalibrationDataError(
            f"{bag.path}: no topic holds transforms (tf2_msgs/TFMessage); record /tf and "
            f"/tf_static. The topics: {bag.listed_topics()}."
        )
    edges: dict[str, Edge] = {}
    for topic in topics:
        static = topic.rstrip("/").endswith("_static")
        for _, message in bag.messages(topic):
            for one in message.transforms:
                _add(edges, one, static, str(bag.path))
    return edges


def _add(edges: dict[str, Edge], one: Any, static: bool, source: str) -> None:  # noqa: ANN401
    parent, child = one.header.frame_id.lstrip("/"), one.child_frame_id.lstrip("/")
    edge = edges.setdefault(child, Edge(parent, static))
    if edge.parent != parent:
        raise CalibrationDataError(
            f"{source}: tf gives the frame '{child}' two parents, '{edge.parent}' and '{parent}'."
        )
    move, turn = one.transform.translation, one.transform.rotation
    place, quaternion = [move.x, move.y, move.z], [turn.x, turn.y, turn.z, turn.w]
    try:
        edge.poses.append(pose_from_quaternion(np.array(place), np.array(quaternion)))
    except ValueError as error:
        raise CalibrationDataError(f"{source}: tf {parent} -> {child}: {error}.") from None
    # A frame that is published on both topics moves.
    edge.static = edge.static and static
    edge.times.append(one.header.stamp.sec + 1e-9 * one.header.stamp.nanosec)


def base_from_tool(edges: dict[str, Edge], base: str, tool: str, source: str) -> PoseTrack:
    """Return the poses of the tool in the base.

    Between the stamps of a frame its transform is interpolated; the result has the stamps of all
    moving frames on the way, as far as all of them are known.

    Args:
        edges: From `read_tf`.
        base: Name of the robot's base.
        tool: Name of its tool.
        source: The bag, for messages.

    Raises:
        CalibrationDataError: A frame is missing, they are not connected, or do not move.
    """
    up, down = _chain(edges, base, source), _chain(edges, tool, source)
    common = next((name for name in down if name in up), None)
    if common is None:
        raise CalibrationDataError(
            f"{source}: tf does not connect '{base}' (under '{up[-1]}') with '{tool}' (under "
            f"'{down[-1]}'). Is /tf_static recorded?"
        )
    to_tool = down[: down.index(common)][::-1]
    to_base = up[: up.index(common)][::-1]
    moving: dict[str, PoseTrack] = {}
    for child in (*to_tool, *to_base):
        if not (edge := edges[child]).static:
            order, times = np.argsort(edge.times, kind="stable"), np.array(edge.times)
            name = f"{source}: tf {edge.parent} -> {child}"
            moving[child] = PoseTrack.checked(np.array(edge.poses)[order], name, times[order])
    if not moving:
        raise CalibrationDataError(
            f"{source}: every transform between '{base}' and '{tool}' is static; the tool does "
            "not move. Is --tool-frame the flange or the tool of the arm?"
        )
    # The stamps of all tracks within the time that all of them cover.
    stamps = [track.timestamp for track in moving.values() if track.timestamp is not None]
    times = np.unique(np.concatenate(stamps))
    first, last = max(time[0] for time in stamps), min(time[-1] for time in stamps)
    times = times[(times >= first) & (times <= last)]
    if not len(times):
        names = [track.source.rpartition(": ")[2] for track in moving.values()]
        raise CalibrationDataError(f"{source}: {' and '.join(names[:2])} share no time.")

    def product(children: Iterable[str]) -> torch.Tensor:
        whole = torch.eye(4, dtype=torch.float64).expand(len(times), 4, 4)
        for child in children:
            pose = moving[child].at(times) if child in moving else edges[child].poses[-1]
            whole = whole @ torch.from_numpy(pose)
        return whole

    poses = se3.inverse(product(to_base)) @ product(to_tool)
    return PoseTrack.checked(poses.numpy(), f"{source}: tf {base} -> {tool}", times)


def _chain(edges: dict[str, Edge], name: str, source: str) -> list[str]:
    """Return a frame and its ancestors, the root last."""
    known = set(edges) | {edge.parent for edge in edges.values()}
    if name not in known:
        listed = ", ".join(sorted(known)[:40])
        raise CalibrationDataError(f"{source}: tf has no frame '{name}'. Its frames: {listed}.")
    chain = [name]
    while chain[-1] in edges:
        parent = edges[chain[-1]].parent
        if parent in chain:
            raise CalibrationDataError(f"{source}: tf goes round in a circle at '{parent}'.")
        chain.append(parent)
    return chain
