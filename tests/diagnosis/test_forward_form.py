"""Why a diagnosis is decided in the forward form.

With measured distances among its regressors the point-to-plane residual can be shrunk to nothing:
a robot whose scale is zero and a camera whose distances are all wrong by themselves put every
point into one place. Data in which nothing is missing then seem to be explained by robot
kinematics.
"""

import torch
from torch import Tensor

from tofcorr.diagnosis.findings.naming import name_effects
from tofcorr.diagnosis.sums.linear_system import BASE
from tofcorr.diagnosis.sums.study import Study


def _point_to_plane(study: Study) -> tuple[Tensor, Tensor, Tensor]:
    """Return residual, base columns with measured distance, and columns of the robot's scale."""
    facts, frame = study.inputs.facts, study.inputs.frame
    pose = facts.world_from_tool @ study.fit.tool_from_camera
    directions = (pose[frame, :3, :3] @ study.inputs.rays[:, :, None])[..., 0]
    measured = study.observations.measured
    normal = facts.normal_world[frame]
    points = directions * measured[:, None] + pose[frame, :3, 3]
    residual = (normal * points).sum(1) + facts.offset[frame]
    slope = (normal * directions).sum(1, keepdim=True)
    # The same columns as the forward form's, but of the measured distance.
    error = study.fit.model.error_columns(measured) * slope
    hand_eye = study.columns[BASE][:, : study.fit.model.num_hand_eye] * slope
    scale = normal * facts.world_from_tool[frame, :3, 3]
    return residual, torch.cat([hand_eye, error], dim=1), scale


def _left_over(residual: Tensor, columns: Tensor) -> float:
    solved = torch.linalg.lstsq(columns, residual[:, None], driver="gelsd").solution[:, 0]
    return float((residual - columns @ solved).square().sum())


def test_point_to_plane_would_explain_by_the_robot_what_is_not_there(nothing_study: Study) -> None:
    residual, base, scale = _point_to_plane(nothing_study)
    without = _left_over(residual, base)
    explained = 1 - _left_over(residual, torch.cat([base, scale], dim=1)) / without
    assert explained > 0.9


def test_the_forward_form_does_not(nothing_study: Study) -> None:
    named = name_effects(nothing_study)
    robot = float(named.closed["robot_kinematics"].sum())
    assert robot < 0.01 * named.squares
    assert named.names == ()
