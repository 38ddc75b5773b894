"""The pose of the camera on the robot, as the formats for robots write it."""

from collections.abc import Iterable

from scipy.spatial.transform import Rotation

from tofcorr.correction.state import CalibrationState
from tofcorr.errors import ConfigError
from tofcorr.version import __version__


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
            lines.append(f"NOT DETERMINED, nor in these (t along, w about its axes): {lacking}.")
        return lines

    def comment(self) -> str:
        """Return the same as comments of YAML."""
        return "".join(f"# {line}\n" for line in self.in_words())


def decimals(values: Iterable[float]) -> list[str]:
    """Return numbers with ten digits behind the point; no sign before a zero."""
    return [f"{round(value, 10) + 0.0:.10f}" for value in values]
