"""A robot's arm by its description (URDF): where its tool is at joint angles, and how it moves.

The chain is a product of fixed transforms and of joint motions,
T = F_0 exp(a_1 q_1) F_1 ... exp(a_J q_J) F_J, with a_j the unit twist of joint j in its own frame.
The length of a link is a sliding joint whose q is zero: its error is an offset, as of any joint.
"""

import math
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Bool, Float
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
        names: Of the joints that move, from base to tip, and of lengths, such as `elbow z`.
        fixed: The transforms before, between and after them, shape (J + 1, 4, 4).
        twists: The unit twist of each joint in its own frame, shape (J, 6).
        tolerance: Standard deviation of each length, metres; infinite for joints, shape (J,).
    """

    names: tuple[str, ...]
    fixed: Float[Tensor, "J1 4 4"]
    twists: Float[Tensor, "J 6"]
    tolerance: Float[Tensor, "J"]

    @property
    def turns(self) -> list[bool]:
        """Which joints turn, in radians; the others and the lengths are in metres."""
        return self.twists[:, 3:].any(dim=1).tolist()

    @property
    def is_length(self) -> Bool[Tensor, "J"]:
        """Which of them are lengths, for which no angle is recorded."""
        return self.tolerance.isfinite()

    def placed(
        self, angles: Float[Tensor, "*N M"], lengths: Float[Tensor, "L"] | float = 0.0
    ) -> Float[Tensor, "*N J"]:
        """Return what is recorded of the joints, with errors of the lengths in their places."""
        full = angles.new_zeros(*angles.shape[:-1], len(self.names))
        full[..., ~self.is_length] = angles
        full[..., self.is_length] = torch.as_tensor(lengths).to(angles)
        return full

    @classmethod
    def read(
        cls,
        path: Path | str,
        base: str | None = None,
        tip: str | None = None,
        tolerance: float = math.inf,
    ) -> "Arm":
        """Read the chain between two links of a robot description.

        Args:
            path: A URDF file; expand xacro before.
            base: Link where the chain begins; None, or no link of this name: the root.
            tip: Link where it ends; None, or no link of this name: the only link without children.
            tolerance: Of lengths, metres: numbers in an `origin` that are larger are lengths.

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
        one, moves = torch.eye(6, dtype=torch.float64), list[tuple[str, Tensor, Tensor, float]]()
        before = still = one[:4, :4]
        for joint in chain:
            origin, (name, kind) = (
                origin_of(joint, path),
                (joint.get(k, "") for k in ("name", "type")),
            )
            for k in (origin[:3, 3].abs() > tolerance).nonzero()[:, 0].tolist():
                moves.append((f"{name} {'xyz'[k]}", before, one[k], tolerance))
                before = still
            before = before @ origin
            if kind in _MOVING:
                axis = _numbers(joint.find("axis"), "xyz", path, (1.0, 0.0, 0.0))
                twist = torch.nn.functional.normalize(axis, dim=0) @ one[_MOVING[kind] :][:3]
                moves.append((name, before, twist, math.inf))
                before = still
            elif kind != "fixed":
                said = f"joint {name} is of type '{kind}'"
                raise ConfigError(f"{path}: {said}; known: {', '.join(_MOVING)}, fixed.")
        if all(math.isfinite(slack) for *_, slack in moves):
            raise ConfigError(f"{path}: no joint moves between '{base}' and '{tip}'.")
        names, fixed, twists, tolerances = zip(*moves, strict=True)
        parts = torch.stack([*fixed, before]), torch.stack(twists)
        return cls(names, *parts, before.new_tensor(tolerances))

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
        return se3.inverse(joint_from_tip) @ se3.hat(self.twists) @ joint_from_tip


@dataclass(frozen=True, eq=False)
class PosedArm:
    """An arm at the frames of a recording, with offsets of some of its joints.

    Attributes:
        arm: The chain.
        chosen: Places of the joints whose offsets are asked for.
        angles: Of all joints at each frame, as recorded, and zero for lengths, shape (N, J).
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
