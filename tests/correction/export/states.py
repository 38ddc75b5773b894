"""Calibrations with known hand-eye transforms, for tests of the formats that robots read."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from cameras import rigid
from kinds_of_terms import DOMAIN
from scipy.spatial.transform import Rotation
from small_recordings import CAMERA
from synthetic_scene import EA

from tofcorr.correction.corrector import DepthCorrector
from tofcorr.correction.export import export
from tofcorr.correction.state import CalibrationState, HandEyeAccuracy
from tofcorr.error_terms.model import ErrorModel, ErrorModelOptions
from tofcorr.geometry.camera import FrameNames

NAMES = FrameNames(world="base_link", tool="tool0", camera="tof_optical_frame")
EYE_TO_HAND = NAMES.model_copy(update={"world": "tool0", "tool": "base_link", "eye_to_hand": True})
ACCURACY = HandEyeAccuracy(
    translation_se_mm=(0.12, 0.15, 0.34), rotation_se_deg=(0.011, 0.012, 0.023)
)
TERMS = EA["terms"]


def calibration(
    transform: np.ndarray | None = None,
    terms: Sequence[Mapping[str, Any]] = TERMS,
    depth_kind: str = "z",
    **changed: Any,
) -> CalibrationState:
    """Return a calibration with a hand-eye transform (4, 4) and random errors of about 20 mm."""
    options = ErrorModelOptions.from_mapping({"terms": terms}, "test")
    model = ErrorModel(options, changed.get("domain", DOMAIN))
    generator = torch.Generator().manual_seed(3)
    values: dict[str, Any] = {
        "name": "EA",
        "error_model": options,
        "domain": DOMAIN,
        "coefficients": 0.02 * torch.randn(len(model.symbols()), generator=generator).double(),
        "tool_from_camera": torch.eye(4).double() if transform is None else torch.tensor(transform),
        "hand_eye_estimated": True,
        "camera": replace(CAMERA, distortion=(-0.05, 0.01, 0.001, -0.002)),
        "depth_kind": depth_kind,
        "frames": NAMES,
        "hand_eye_accuracy": ACCURACY,
    }
    if model.fixed_pattern is not None:
        size = model.fixed_pattern.offset.shape
        values["fixed_pattern"] = 0.02 * torch.randn(size, generator=generator).double()
    return CalibrationState(**(values | changed))


def transform_of(euler_deg: tuple[float, float, float]) -> np.ndarray:
    """Return a transform (4, 4) of fixed-axis angles about x, y, z."""
    turn = Rotation.from_euler("xyz", euler_deg, degrees=True)
    return rigid(turn, (0.0312, -0.0541, 0.1273))


# Upright, general, at both ends of the pitch (where roll and yaw are not unique), and half turns.
TRANSFORMS = {
    "identity rotation": transform_of((0, 0, 0)),
    "general": transform_of((-91.3, 2.4, 88.1)),
    "pitch +90": transform_of((20, 90, -35)),
    "pitch -90": transform_of((140, -90, 10)),
    "almost pitch 90": transform_of((20, 90 - 1e-6, -35)),
    "half turn about x": transform_of((180, 0, 0)),
    "half turn about z": transform_of((0, 0, 180)),
}


def write(name: str, state: CalibrationState, path: Any) -> None:
    """Export a calibration as the command does."""
    export(name, DepthCorrector.from_state(state), path, state)
