"""Robot descriptions (URDF, xacro): the camera's pose as a fixed joint, and a corrected robot."""

import math
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path

import numpy as np
import torch
from jinja2 import Template

from tofcorr.correction.corrector import DepthCorrector
from tofcorr.correction.export.pose import Mount, decimals
from tofcorr.correction.state import CalibrationState
from tofcorr.files import write_text
from tofcorr.geometry import se3
from tofcorr.geometry.arm import Arm, origin_of
from tofcorr.options import read_text


def export_urdf(corrector: DepthCorrector, path: Path | str, reference: CalibrationState) -> None:
    """Write a link for the camera's optical frame, and the fixed joint that carries it.

    The robot's own description defines the parent link. `origin` is the pose of the child in the
    parent: xyz in metres, and rpy in radians about the parent's fixed axes,
    R = Rz(yaw) Ry(pitch) Rx(roll).

    Args:
        corrector: The float32 runtime; not needed here.
        path: The file to write; an older one is replaced.
        reference: The calibration.

    Raises:
        ConfigError: The calibration has no estimated hand-eye transform.
        ExportError: The file cannot be written.
    """
    mount = Mount(reference, "urdf")
    template = Template(
        files("tofcorr.correction.export").joinpath("urdf.xacro.j2").read_text("utf-8"),
        autoescape=True,
        trim_blocks=True,
        keep_trailing_newline=True,
    )
    text = template.render(
        # Two hyphens would end an XML comment.
        words=[line.replace("--", "- -") for line in mount.in_words()],
        parent=mount.frames.tool,
        child=mount.frames.camera,
        xyz=" ".join(decimals(mount.translation)),
        rpy=" ".join(decimals(roll_pitch_yaw(mount.transform[:3, :3]))),
    )
    write_text(path, text)


def corrected_description(urdf: Path | str, arm: Arm, offsets: Mapping[str, float]) -> str:
    """Return a robot's description with offsets of joints, and of lengths, in the joints' origins.

    Angles as the controller reports them then give the true poses: origin exp(axis (q + offset)) is
    a new origin, times exp(axis q).

    Args:
        urdf: The description.
        arm: The chain that it holds.
        offsets: By joint or length, radians or metres.
    """
    parser = ET.XMLParser(target=ET.TreeBuilder(insert_comments=True))
    root = ET.fromstring(read_text(Path(urdf)), parser)
    still = torch.eye(4, dtype=torch.float64)
    moves = {
        name: se3.exp(offset * arm.twists[arm.names.index(name)])
        for name, offset in offsets.items()
    }
    for joint in root.findall("joint"):
        name = joint.get("name", "")
        keys = [*(f"{name} {axis}" for axis in "xyz"), name]
        if moves.keys().isdisjoint(keys):
            continue
        x, y, z, turned = (moves.get(one, still) for one in keys)
        origin = joint.find("origin")
        pose = (x @ y @ z @ origin_of(joint, urdf) @ turned).numpy()
        origin = ET.SubElement(joint, "origin") if origin is None else origin
        origin.set("xyz", " ".join(decimals(pose[:3, 3])))
        origin.set("rpy", " ".join(decimals(roll_pitch_yaw(pose[:3, :3]))))
    return f'<?xml version="1.0"?>\n{ET.tostring(root, encoding="unicode")}\n'


def roll_pitch_yaw(rotation: np.ndarray) -> tuple[float, float, float]:
    """Return the angles of R = Rz(yaw) Ry(pitch) Rx(roll), radians; exact at any pitch.

    At a pitch of 90 degrees only the difference of roll and yaw matters. The roll is therefore
    taken from what remains once the yaw is removed.
    """
    yaw = math.atan2(rotation[1, 0], rotation[0, 0])
    s, c = math.sin(yaw), math.cos(yaw)
    pitch = math.atan2(-rotation[2, 0], math.hypot(rotation[0, 0], rotation[1, 0]))
    roll = math.atan2(
        s * rotation[0, 2] - c * rotation[1, 2], c * rotation[1, 1] - s * rotation[0, 1]
    )
    return roll, pitch, yaw
