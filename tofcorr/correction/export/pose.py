"""The pose of the camera on the robot, as the formats for robots write it."""

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from tofcorr.correction.state import CalibrationState
from tofcorr.errors import ConfigError, ExportError
from tofcorr.files import staged_file
from tofcorr.version import __version__

# Largest difference of any entry of the transform that is read back, metres or no unit. Numbers
# are written to 1e-10; their products in a rotation matrix add up to a few times that.
_TOLERANCE = 1e-8


class Mount:
    """The pose of the camera's optical frame in the frame that carries it.

    Args:
        state: The calibration.
        format_name: Of the export, for the message.

    Raises:
        ConfigError: The calibration did not estimate it.

    Attributes:
        frames: The names; `frames.tool` carries the camera.
        accuracy: Standard errors of the transform; None if unknown.
        transform: tool_from_camera, shape (4, 4), metres.
        translation: The camera's optical centre, x y z, metres.
        quaternion: The rotation as x y z w, w not negative.
    """

    def __init__(self, state: CalibrationState, format_name: str) -> None:
        if not state.hand_eye_estimated:
            said = f"{format_name} needs an estimated hand-eye transform, and {state.name} has none"
            raise ConfigError(f"{said}: train on a recording with robot poses.")
        self.frames, self.accuracy = state.frames, state.hand_eye_accuracy
        self.transform = state.tool_from_camera.detach().cpu().double().numpy()
        self.translation: list[float] = self.transform[:3, 3].tolist()
        rotation = Rotation.from_matrix(self.transform[:3, :3])
        self.quaternion: list[float] = rotation.as_quat(canonical=True).tolist()

    def mapping(self) -> dict[str, dict[str, float]]:
        """Return translation and rotation by axis, as geometry_msgs/Transform."""
        translation = dict(zip("xyz", self.translation, strict=True))
        return {
            "translation": translation,
            "rotation": dict(zip("xyzw", self.quaternion, strict=True)),
        }

    def in_words(self) -> list[str]:
        """Return what a reader must know of the numbers, one line each, for comments."""
        parent, child = self.frames.tool, self.frames.camera
        lines = [
            f"Pose of the optical frame '{child}' in '{parent}', by tofcorr {__version__}.",
            f"Axes of '{child}': x right, y down, z forward (an optical frame of REP 103).",
        ]
        if self.frames.eye_to_hand:
            lines.append("The camera stands still; the robot carries the target.")
        if self.accuracy is None:
            return [*lines, "Standard errors are unknown."]
        translation = " ".join(f"{value:.3f}" for value in self.accuracy.translation_se_mm)
        rotation = " ".join(f"{value:.4f}" for value in self.accuracy.rotation_se_deg)
        errors = f"{translation} mm; about them: {rotation} deg"
        lines.append(f"Standard errors along x y z of '{parent}': {errors}.")
        if self.accuracy.undetermined:
            lacking = "; ".join(self.accuracy.undetermined)
            lines.append(f"NOT DETERMINED, nor in the standard errors: {lacking} (camera's axes).")
        return lines

    def comment(self) -> str:
        """Return the same as comments of YAML."""
        return "".join(f"# {line}\n" for line in self.in_words())


def write_pose(
    path: Path | str,
    content: str | Callable[[Path], None],
    read: Callable[[Path], np.ndarray],
    mount: Mount | None,
) -> None:
    """Write a file, read it back, and refuse one that states another transform (4, 4).

    Args:
        path: The file; an older one is replaced.
        content: Its text, or what writes it.
        read: Returns the transform that the file states.
        mount: The pose; None: there is none to compare with.

    Raises:
        ExportError: They differ, or the file cannot be written.
    """
    with staged_file(path) as part:
        if isinstance(content, str):
            part.write_text(content, encoding="utf-8")
        else:
            content(part)
        if mount is None:
            return
        found = read(part)
        if found.shape != mount.transform.shape:
            raise ExportError(f"{path}: holds no transform after writing; nothing was written.")
        apart = float(np.abs(found - mount.transform).max())
        if not apart < _TOLERANCE:
            raise ExportError(f"{path}: the transform is off by {apart:.1e}; nothing was written.")


def decimals(values: Iterable[float]) -> list[str]:
    """Return numbers with ten digits behind the point; no sign before a zero."""
    return [f"{round(value, 10) + 0.0:.10f}" for value in values]


def transform_of(mapping: Mapping[str, Any]) -> np.ndarray:
    """Return the transform (4, 4) of what `Mount.mapping` gave."""
    transform = np.eye(4)
    quaternion = [mapping["rotation"][axis] for axis in "xyzw"]
    transform[:3, :3] = Rotation.from_quat(quaternion).as_matrix()
    transform[:3, 3] = [mapping["translation"][axis] for axis in "xyz"]
    return transform
