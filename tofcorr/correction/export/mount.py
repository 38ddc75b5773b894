"""The pose of the camera on the robot, as the formats for robots write it."""

from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from tofcorr.correction.hand_eye_accuracy import HandEyeAccuracy
from tofcorr.correction.state import CalibrationState
from tofcorr.errors import ConfigError, ExportError
from tofcorr.geometry.camera import FrameNames
from tofcorr.version import __version__

# Largest difference of any entry of the transform that is read back, metres or no unit. Numbers
# are written to 1e-10; their products in a rotation matrix add up to a few times that.
_TOLERANCE = 1e-8


class Mount(NamedTuple):
    """The pose of the camera's optical frame in the frame that carries it.

    Attributes:
        frames: The names; `frames.tool` carries the camera.
        transform: tool_from_camera, shape (4, 4), metres.
        accuracy: Its standard errors; None if unknown.
    """

    frames: FrameNames
    transform: np.ndarray
    accuracy: HandEyeAccuracy | None

    @classmethod
    def of(cls, state: CalibrationState, format_name: str) -> "Mount":
        """Return the pose that a calibration estimated.

        Raises:
            ConfigError: The calibration did not estimate it.
        """
        if not state.hand_eye_estimated:
            raise ConfigError(
                f"The {format_name} export needs an estimated hand-eye transform. The calibration "
                f"{state.name} has none: its recording has no robot poses, or its configuration "
                "says hand_eye.estimate: no. Train on a recording with the robot's poses."
            )
        transform = state.tool_from_camera.detach().cpu().double().numpy()
        return cls(state.frames, transform, state.hand_eye_accuracy)

    @property
    def translation(self) -> list[float]:
        """The camera's optical centre, x y z, metres."""
        return self.transform[:3, 3].tolist()

    @property
    def quaternion(self) -> list[float]:
        """The rotation as x y z w, w not negative."""
        return Rotation.from_matrix(self.transform[:3, :3]).as_quat(canonical=True).tolist()

    def in_words(self) -> list[str]:
        """Return what a reader must know of the numbers, one line each, for comments."""
        parent, child = self.frames.tool, self.frames.camera
        stands = "The camera stands still; the robot carries the target."
        return [
            f"Pose of the optical frame '{child}' in '{parent}', by tofcorr {__version__}.",
            f"Axes of '{child}': x right, y down, z forward (an optical frame of REP 103).",
            *([stands] if self.frames.eye_to_hand else []),
            *self._accuracy_in_words(),
        ]

    def _accuracy_in_words(self) -> list[str]:
        if self.accuracy is None:
            return ["Standard errors are unknown."]
        translation = " ".join(f"{value:.3f}" for value in self.accuracy.translation_se_mm)
        rotation = " ".join(f"{value:.4f}" for value in self.accuracy.rotation_se_deg)
        lines = [
            f"Standard errors along x y z of '{self.frames.tool}': {translation} mm; "
            f"about them: {rotation} deg."
        ]
        if self.accuracy.undetermined:
            lines.append(
                "NOT DETERMINED by the recording (t along, w about the camera's axes), and not in "
                f"the standard errors: {'; '.join(self.accuracy.undetermined)}."
            )
        return lines


def decimals(values: Iterable[float]) -> list[str]:
    """Return numbers with ten digits behind the point; no sign before a zero."""
    return [f"{round(value, 10) + 0.0:.10f}" for value in values]


def transform_of(translation: list[float], quaternion: list[float]) -> np.ndarray:
    """Return the transform (4, 4) of x y z and a quaternion x y z w."""
    transform = np.eye(4)
    transform[:3, :3] = Rotation.from_quat(quaternion).as_matrix()
    transform[:3, 3] = translation
    return transform


def require_same(path: Path | str, read_back: np.ndarray, mount: Mount) -> None:
    """Refuse a file that states another transform (4, 4) than the calibration.

    Raises:
        ExportError: They differ.
    """
    if read_back.shape != mount.transform.shape:
        raise ExportError(f"{path}: holds no transform after writing; nothing was written.")
    apart = float(np.abs(read_back - mount.transform).max())
    if not apart < _TOLERANCE:
        raise ExportError(
            f"{path}: the transform that was written differs from the calibration by {apart:.1e}; "
            "nothing was written."
        )
