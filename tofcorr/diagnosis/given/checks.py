"""Refuses rendered frames that cannot be compared with a recording."""

import torch
from torch import Tensor

from tofcorr.data.recording import Recording
from tofcorr.diagnosis.sums.observations import Observations
from tofcorr.diagnosis.sums.prediction import predicted_distance
from tofcorr.errors import CalibrationDataError
from tofcorr.geometry.rays import ray_directions

# Two cameras are the same if no pixel's ray differs by more than this, pixels. Chosen: at an
# incidence of 45 degrees it changes a distance of 1 m by 0.1 mm at 100 pixels of focal length.
_SAME_RAY_PX = 0.01
# Rendered frames whose median distance is off by more than this from their own planes, metres, are
# refused. Chosen: no depth camera is as wrong, and every mistaken axis or unit gives more.
_ABSURD = 0.3
# The kind of depth is wrong if the difference from the planes follows the difference between the
# kinds with a slope within this of -1. The slope is 0 if the kind is right; chosen, far from both.
_SLOPE_TOLERANCE = 0.3


def refuse_other_camera(real: Recording, simulated: Recording) -> None:
    """Refuse frames of another image size or of other viewing rays.

    Raises:
        CalibrationDataError: The cameras differ; the sentence says by how much.
    """
    one, other = real.camera, simulated.camera
    if (one.width, one.height) != (other.width, other.height):
        raise CalibrationDataError(
            f"{simulated.path}: its images have {other.width} x {other.height} pixels, those of "
            f"{real.path} {one.width} x {one.height}; render with the recording's own camera."
        )
    apart = (ray_directions(one) - ray_directions(other)).norm(dim=-1).max()
    pixels = float(apart) * max(one.matrix[0][0], one.matrix[1][1])
    if not pixels <= _SAME_RAY_PX:
        raise CalibrationDataError(
            f"{simulated.path}: its pixels look up to {pixels:.2g} pixels beside those of "
            f"{real.path}; render with the recording's own K and distortion (recording.yaml: "
            "camera)."
        )


def refuse_without_truth(simulated: Recording, observations: Observations) -> None:
    """Refuse frames that disagree with their own geometry beyond what any camera does.

    Args:
        simulated: The rendered frames.
        observations: Their pixels.

    Raises:
        CalibrationDataError: Planes, hand-eye transform, axes, unit or kind of depth are wrong.
    """
    if simulated.planes == "estimated":
        raise CalibrationDataError(
            f"{simulated.path}: its planes are estimated from the depth (recording.yaml: planes); "
            "a simulator knows its walls: write them to frames.csv."
        )
    pose = torch.from_numpy(simulated.tool_from_camera)
    truth = predicted_distance(observations, pose)
    off = _typical(observations.measured - truth)
    other = "z" if simulated.depth_kind == "radial" else "radial"
    rays = ray_directions(simulated.camera).reshape(-1, 3)[observations.pixel]
    factor = 1 / rays[:, 2] if other == "z" else rays[:, 2]
    slope = _slope(observations.measured - truth, observations.measured * (factor - 1))
    if abs(slope + 1) < _SLOPE_TOLERANCE:
        raise CalibrationDataError(
            f"{simulated.path}: its depth differs from its own planes as depth_kind {other} "
            f"does from {simulated.depth_kind}; render {simulated.depth_kind} depth, or correct "
            "depth_kind in their own recording.yaml."
        )
    if not off <= _ABSURD:
        raise CalibrationDataError(
            f"{simulated.path}: its depth is {off:.2f} m off from its own planes; check "
            "tool_from_camera and its axes (x right, y down, z forward), the planes in "
            "frames.csv, and the unit of depth.npy (metres)."
        )


def _slope(difference: Tensor, between_kinds: Tensor) -> float:
    """Return the slope of a line through the differences of pixels whose plane is known."""
    use = difference.isfinite()
    x, y = between_kinds[use], difference[use]
    x = x - x.mean()
    return float((x * y).sum() / x.square().sum().clamp(min=1e-30))


def _typical(difference: Tensor) -> float:
    return float(difference.abs().nan_to_num(torch.inf).median())
