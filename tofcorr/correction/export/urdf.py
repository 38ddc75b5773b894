"""The camera's pose as a fixed joint of a robot description (URDF, xacro)."""

import math
from importlib.resources import files
from pathlib import Path

import numpy as np
from jinja2 import Template

from tofcorr.correction.corrector import DepthCorrector
from tofcorr.correction.export.pose import Mount, decimals
from tofcorr.correction.state import CalibrationState
from tofcorr.files import write_text


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
