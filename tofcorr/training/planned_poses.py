"""Which poses to record first: chosen from camera and wall alone, before any recording exists."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from tofcorr.conditions import CONDITIONS
from tofcorr.error_terms.domain import Domain, Interval
from tofcorr.error_terms.model import ErrorModel, ErrorModelOptions
from tofcorr.estimation.advice import Views, choose_views, predicted_moments
from tofcorr.estimation.design import Design
from tofcorr.estimation.information import PRIOR_SIGMA
from tofcorr.estimation.parameters import Parameters
from tofcorr.estimation.planes import Walls, joint_image_equations
from tofcorr.geometry import se3
from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.geometry.planes import plane_in_frame
from tofcorr.geometry.rays import ray_directions
from tofcorr.training.next_poses import STEEPEST_INCIDENCE_DEG
from tofcorr.training.workspace import Workspace, draw_views

# How many independent pixels an image counts for: its pixels share the errors of pose and target.
# Set on the configurations demo, set2 and set3, where an image counts for 140 to 330.
_INDEPENDENT_PIXELS = 100
# A direction counts as determined below this share of the wide prior's standard deviation; as in
# `observability`.
_DETERMINED = math.sqrt(0.5)
# Reflectivity of a checkerboard's dark squares relative to its bright ones, as in `next_poses`.
_LOG_DARK = math.log(1 / 8)


class HandEyeErrors(NamedTuple):
    """Expected standard errors of the hand-eye transform; infinite while it is not determined.

    Attributes:
        translation_mm: Of the worst axis of the translation.
        rotation_deg: About the worst axis.
    """

    translation_mm: float
    rotation_deg: float


@dataclass(frozen=True, kw_only=True, eq=False)
class PosePlan:
    """Poses to record, the most informative first.

    Attributes:
        start_from_tool: Poses of the tool relative to where it starts, shape (N, 4, 4), metres.
        described: Distance (m), tilt and roll (degrees) of each, shape (N, 3).
        expected: What is to be expected after the first k poses, N entries.
    """

    start_from_tool: Tensor
    described: Tensor
    expected: tuple[HandEyeErrors, ...]

    def __repr__(self) -> str:
        """Return the expected standard errors after every few poses, as a table."""
        lines = ["poses   hand-eye: worst axis of translation    rotation"]
        count = len(self.expected)
        for k in sorted({*range(5, count, 5), count}):
            found = self.expected[k - 1]
            if math.isinf(found.translation_mm + found.rotation_deg):
                lines.append(f"{k:5d}   not determined")
            else:
                lines.append(
                    f"{k:5d}   {found.translation_mm:24.2f} mm {found.rotation_deg:16.3f} deg"
                )
        return "\n".join(lines)


def plan_poses(
    camera: CameraIntrinsics,
    model: ErrorModelOptions,
    workspace: Workspace,
    *,
    number: int = 24,
    start_distance: float | None = None,
    tool_from_camera: np.ndarray | None = None,
    residual: float = 2.5e-3,
    seed: int = 0,
) -> PosePlan:
    """Choose poses that determine the hand-eye transform, the model and the wall best.

    The robot starts where the camera looks squarely at the wall. Candidates keep looking at the
    same point of it, tilted, rolled and moved. They are chosen one by one, each the one that most
    reduces the variances that remain; the wall's own plane counts as unknown.

    Args:
        camera: The lateral parameters.
        model: The error terms.
        workspace: Where the camera may go.
        number: How many poses.
        start_distance: From the camera to the wall at the start, metres; None: the middle.
        tool_from_camera: A guess of the hand-eye transform, shape (4, 4), good to 0.1 m and some
            degrees; None: the tool's axes are the camera's.
        residual: RMS error of a pixel that the correction leaves, metres; the default is that of
            the simulated configurations. Expected standard errors are proportional to it.
        seed: Of the candidates.

    Raises:
        ConfigError: The wall is too small for every view.
    """
    hand_eye = torch.eye(4).double() if tool_from_camera is None else torch.tensor(tool_from_camera)
    middle = (workspace.nearest + workspace.farthest) / 2
    generator = np.random.default_rng(seed)
    candidates = draw_views(camera, workspace, start_distance or middle, generator)
    cameras, described, normal, offset = candidates
    world_from_tool = cameras @ se3.inverse(hand_eye)
    normals, offsets = normal.expand(len(cameras), 3), offset.expand(len(cameras))
    normal_tool, offset_tool = plane_in_frame(normals, offsets, world_from_tool)
    brightness = torch.tensor([_LOG_DARK if workspace.checkerboard else 0.0, 0.0]).double()
    views = Views(normal_tool, offset_tool, brightness.expand(len(cameras), 2))
    domain = _domain(camera, workspace)
    error = ErrorModel(model, domain)
    design = Design(error, domain, ray_directions(camera))
    share = min(1.0, _INDEPENDENT_PIXELS / (camera.height * camera.width))
    moments = predicted_moments(design, hand_eye, views, share)
    here = Parameters(hand_eye, torch.zeros(len(moments.symbols)).double(), True)
    index = torch.zeros(len(cameras), dtype=torch.long)
    walls = Walls(normal[None], offset[None], index, world_from_tool)
    information = joint_image_equations(moments, here, walls).hessian / residual**2
    nothing = torch.zeros_like(information[0])
    choice = choose_views(nothing, information, number)
    first_from_tool = hand_eye @ world_from_tool[choice.order]
    return PosePlan(
        start_from_tool=first_from_tool,
        described=described[choice.order],
        expected=tuple(_expected(covariance) for covariance in choice.covariances[1:]),
    )


def _domain(camera: CameraIntrinsics, workspace: Workspace) -> Domain:
    """Return ranges that scale the variables; any that contain the views serve."""
    grazing = math.cos(math.radians(STEEPEST_INCIDENCE_DEG))
    dark = grazing * math.exp(_LOG_DARK if workspace.checkerboard else 0.0)
    far = workspace.farthest / grazing
    return Domain(
        height=camera.height,
        width=camera.width,
        radial_distance=Interval(workspace.nearest, far),
        amplitude=Interval(dark / far**2, 1 / workspace.nearest**2),
        normalised_amplitude=Interval(dark, 1.0),
        modulation_frequency=20e6,
        conditions=dict.fromkeys(CONDITIONS, (0.0, 1.0, 0.5)),
    )


def _expected(covariance: Tensor) -> HandEyeErrors:
    """Return the standard errors of the worst axes, from the covariance of all unknowns."""

    def worst(part: Tensor) -> float:
        sigma = float(torch.linalg.eigvalsh(part)[-1].clamp(min=0).sqrt())
        return sigma if sigma < _DETERMINED * PRIOR_SIGMA else math.inf

    return HandEyeErrors(1e3 * worst(covariance[:3, :3]), math.degrees(worst(covariance[3:6, 3:6])))
