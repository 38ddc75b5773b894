"""A robot's arm by its description (URDF): where its tool is at joint angles, and how it moves.

The chain is a product of fixed transforms and of joint motions,
T = F_0 exp(a_1 q_1) F_1 ... exp(a_J q_J) F_J, with a_j the unit twist of joint j in its own frame.
"""

import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from tofcorr.errors import ConfigError
from tofcorr.geometry import se3
from tofcorr.options import read_text

_MOVING = {"revolute": 3, "continuous": 3, "prismatic": 0}
"""Kinds of joints that move, and where the axis stands in their twist: turn or shift."""


@dataclass(frozen=True, eq=False)
class Arm:
    """A chain of joints from a base link to a tip link.

    Attributes:
        names: Of the joints that move, from base to tip.
        turns: Which of them turn, in radians; the others slide, in metres.
        fixed: The transforms before, between and after them, shape (J + 1, 4, 4).
        twists: The unit twist of each joint in its own frame, shape (J, 6).
    """

    names: tuple[str, ...]
    turns: tuple[bool, ...]
    fixed: Float[Tensor, "J1 4 4"]
    twists: Float[Tensor, "J 6"]

    @classmethod
    def read(cls, path: Path | str, base: str | None = None, tip: str | None = None) -> "Arm":
        """Read the chain between two links of a robot description.

        Args:
            path: A URDF file; expand xacro before.
            base: Link where the chain begins; None, or no link of this name: the root.
            tip: Link where it ends; None, or no link of this name: the only link without children.

        Raises:
            ConfigError: The file is no URDF, the tip is not determined, or the chain cannot move.
        """
        joints = {_link(one, "child", path): one for one in _tree(path).findall("joint")}
        parents = {child: _link(joint, "parent", path) for child, joint in joints.items()}
        links = {*parents, *parents.values()}
        leaves = sorted(links - {*parents.values()})
        if tip not in links and len(leaves) != 1:
            said = f"the chain may end at {', '.join(leaves) or 'no link'}"
            raise ConfigError(
                f"{path}: {said}; name one: `frames: {{tool: NAME}}` in the recording."
            )
        link = tip if tip in links else leaves[0]
        chain = list[ET.Element]()
        while link in parents and link != base and len(chain) <= len(parents):
            chain.insert(0, joints[link])
            link = parents[link]
        fixed, twists, names = [torch.eye(4, dtype=torch.float64)], list[Tensor](), list[str]()
        for joint in chain:
            fixed[-1] = fixed[-1] @ origin_of(joint, path)
            kind = joint.get("type", "")
            if kind in _MOVING:
                axis = _numbers(joint.find("axis"), "xyz", path, (1.0, 0.0, 0.0))
                twist = torch.zeros(6, dtype=torch.float64)
                twist[_MOVING[kind] :][:3] = torch.nn.functional.normalize(axis, dim=0)
                twists.append(twist)
                names.append(joint.get("name", ""))
                fixed.append(torch.eye(4, dtype=torch.float64))
            elif kind != "fixed":
                said = f"joint {joint.get('name')} is of type '{kind}'"
                raise ConfigError(f"{path}: {said}; known: {', '.join(_MOVING)}, fixed.")
        if not names:
            raise ConfigError(f"{path}: no joint moves between '{base}' and '{tip}'.")
        turns = tuple(bool(twist[3:].any()) for twist in twists)
        return cls(tuple(names), turns, torch.stack(fixed), torch.stack(twists))

    def _frames(self, angles: Float[Tensor, "N J"]) -> Float[Tensor, "N J1 4 4"]:
        """Return the frame of each joint after its motion, and last that of the tip."""
        here, frames = self.fixed[0].expand(len(angles), 4, 4), list[Tensor]()
        for number, twist in enumerate(self.twists):
            here = here @ se3.exp(angles[:, number, None] * twist)
            frames.append(here)
            here = here @ self.fixed[number + 1]
        return torch.stack([*frames, here], dim=1)

    def poses(self, angles: Float[Tensor, "N J"]) -> Float[Tensor, "N 4 4"]:
        """Return base_from_tip at joint angles, radians or metres."""
        return self._frames(angles)[:, -1]

    def motions(self, angles: Float[Tensor, "N J"]) -> Float[Tensor, "N J 4 4"]:
        """Return M_j with dT / dq_j = T M_j: how each joint moves the tip, in the tip's frame."""
        frames = self._frames(angles)
        joint_from_tip = se3.inverse(frames[:, :-1]) @ frames[:, -1:]
        moves = (self.twists[..., None, None] * se3.GENERATORS.to(angles)).sum(1)
        return se3.inverse(joint_from_tip) @ moves @ joint_from_tip


@dataclass(frozen=True, eq=False)
class PosedArm:
    """An arm at the frames of a recording, with offsets of some of its joints.

    Attributes:
        arm: The chain.
        chosen: Places of the joints whose offsets are asked for.
        angles: Of all joints at each frame, as recorded, shape (N, J).
        tip_from_tool: At each frame, shape (N, 4, 4).
        backwards: Whether `tool` is the robot's base and `world` its tip (eye-to-hand).
    """

    arm: Arm
    chosen: Sequence[int]
    angles: Float[Tensor, "N J"]
    tip_from_tool: Float[Tensor, "N 4 4"]
    backwards: bool = False

    def _moved(self, offsets: Float[Tensor, "K"]) -> Float[Tensor, "N J"]:
        angles = self.angles.clone()
        angles[:, list(self.chosen)] += offsets
        return angles

    def poses(self, offsets: Float[Tensor, "K"]) -> Float[Tensor, "N 4 4"]:
        """Return world_from_tool of each frame with offsets of the chosen joints."""
        found = self.arm.poses(self._moved(offsets)) @ self.tip_from_tool
        return se3.inverse(found) if self.backwards else found

    def motions(self, offsets: Float[Tensor, "K"]) -> Float[Tensor, "N K 4 4"]:
        """Return M_k with d world_from_tool / d offset_k = world_from_tool M_k."""
        own = self.arm.motions(self._moved(offsets))[:, list(self.chosen)]
        tool = self.tip_from_tool[:, None]
        moves = se3.inverse(tool) @ own @ tool
        if not self.backwards:
            return moves
        there = self.poses(offsets)[:, None]  # The inverse of what the arm moves.
        return -se3.inverse(there) @ moves @ there


def _tree(path: Path | str) -> ET.Element:
    text = read_text(Path(path))
    try:
        return ET.fromstring(text)
    except ET.ParseError as error:
        raise ConfigError(f"{path}: is no URDF ({error}).") from None


def _link(joint: ET.Element, role: str, path: Path | str) -> str:
    found = joint.find(role)
    if found is None or "link" not in found.attrib:
        raise ConfigError(f"{path}: joint {joint.get('name')} has no {role} link.")
    return found.attrib["link"]


def _numbers(
    element: ET.Element | None, key: str, path: Path | str, default: tuple[float, float, float]
) -> Float[Tensor, "3"]:
    text = None if element is None else element.get(key)
    try:
        values = default if text is None else tuple(map(float, text.split()))
        found = torch.tensor(values, dtype=torch.float64)
    except ValueError:
        found = torch.zeros(0)
    if found.shape != (3,) or not bool(found.isfinite().all()):
        raise ConfigError(f"{path}: expected three numbers in {key}, got '{text}'.")
    return found


def origin_of(joint: ET.Element, path: Path | str) -> Float[Tensor, "4 4"]:
    """Return parent_from_joint of a joint at zero: R = Rz(yaw) Ry(pitch) Rx(roll)."""
    element, zero = joint.find("origin"), (0.0, 0.0, 0.0)
    shift, angles = (_numbers(element, key, path, zero) for key in ("xyz", "rpy"))
    turns = se3.exp(torch.nn.functional.pad(angles.diag(), (3, 0)))[:, :3, :3]
    return se3.assemble(turns[2] @ turns[1] @ turns[0], shift)
