"""What a run says of the camera's pose on the robot: transform, standard errors, frames' names."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from torch import Tensor

from tofcorr.correction.hand_eye_accuracy import HandEyeAccuracy
from tofcorr.estimation.parameters import HAND_EYE_SYMBOLS
from tofcorr.fit.result import Fit
from tofcorr.geometry.camera import FrameNames


def hand_eye_accuracy(fit: Fit) -> HandEyeAccuracy | None:
    """Return how well a fit knows the hand-eye transform; None if it was not estimated."""
    parameters = fit.solution.parameters
    if not parameters.hand_eye_is_free:
        return None
    rotation = parameters.tool_from_camera[:3, :3]
    covariance = fit.hand_eye_covariance
    return HandEyeAccuracy(
        translation_se_mm=_standard_errors(covariance[:3, :3], rotation, 1e3),
        rotation_se_deg=_standard_errors(covariance[3:6, 3:6], rotation, 180.0 / math.pi),
        undetermined=tuple(
            direction.in_words()
            for direction in fit.observability.undetermined
            if set(direction.shares) & set(HAND_EYE_SYMBOLS)
        ),
    )


def hand_eye_summary(fit: Fit, frames: FrameNames) -> dict[str, Any]:
    """Return the hand-eye transform with standard errors along the tool's axes.

    Args:
        fit: The fitted model.
        frames: What the recording calls the frames; `tool` carries the camera.
    """
    accuracy = hand_eye_accuracy(fit)
    zeros = [0.0, 0.0, 0.0]
    return {
        "tool_from_camera": fit.solution.parameters.tool_from_camera.tolist(),
        "estimated": accuracy is not None,
        "translation_se_mm": zeros if accuracy is None else list(accuracy.translation_se_mm),
        "rotation_se_deg": zeros if accuracy is None else list(accuracy.rotation_se_deg),
        "undetermined": [] if accuracy is None else list(accuracy.undetermined),
        "noise_shift": _noise_shift(fit),
        "frames": frames.to_mapping(),
    }


def hand_eye_text(hand_eye: Mapping[str, Any]) -> str:
    """Return where the camera sits, with standard errors, in one line.

    Args:
        hand_eye: What `hand_eye_summary` gave.
    """
    frames = hand_eye["frames"]
    named = frames != FrameNames().to_mapping()
    where = f" of {frames['camera']} in {frames['tool']}" if named else ""
    translation = [1e3 * row[3] for row in hand_eye["tool_from_camera"][:3]]
    pairs = zip(translation, hand_eye["translation_se_mm"], strict=True)
    return f"hand-eye translation{where}, mm: " + "  ".join(f"{t:.2f} ± {s:.2f}" for t, s in pairs)


def noise_shift_text(hand_eye: Mapping[str, Any]) -> str | None:
    """Return in one line how far the noise of the distances moved the estimate; None: unknown.

    Args:
        hand_eye: What `hand_eye_summary` gave.
    """
    shift = hand_eye["noise_shift"]
    if shift is None:
        return None
    done = "taken off" if shift["removed"] else "not taken off; the standard errors contain it"
    millimetres = "  ".join(f"{t:+z.2f}" for t in shift["translation_mm"])
    return f"  moved by the noise of the distances, mm: {millimetres} ({done})"


def assumptions_summary(fit: Fit) -> list[dict[str, Any]]:
    """Return what errors of intrinsics and planes would do to the transform, as plain values."""
    rotation = fit.solution.parameters.tool_from_camera[:3, :3]
    return [one.to_mapping(rotation) for one in fit.assumptions]


def assumptions_text(assumptions: Sequence[Mapping[str, Any]]) -> str | None:
    """Return in one line what errors of intrinsics and planes would do; None: nothing to say.

    Args:
        assumptions: What `assumptions_summary` gave.
    """
    moved = [
        f"{math.hypot(*one['translation_mm']):.1f} mm for {one['error']}" for one in assumptions
    ]
    return f"  what ± leaves out: {', '.join(moved)}" if moved else None


def _noise_shift(fit: Fit) -> dict[str, Any] | None:
    """Return how far the noise of the distances moves the transform, along the tool's axes."""
    if fit.noise_shift is None:
        return None
    rotation, twist = fit.solution.parameters.tool_from_camera[:3, :3], fit.noise_shift.twist
    return {
        "translation_mm": (1e3 * rotation @ twist[:3]).tolist(),
        "rotation_deg": (180.0 / math.pi * rotation @ twist[3:]).tolist(),
        "removed": fit.noise_shift.removed,
    }


def _standard_errors(
    covariance: Tensor, rotation: Tensor, unit: float
) -> tuple[float, float, float]:
    """Return the standard errors along the tool's axes of a covariance (3, 3) in the camera's."""
    turned = rotation @ covariance @ rotation.T
    x, y, z = (unit * turned.diagonal().clamp(min=0).sqrt()).tolist()
    return x, y, z
