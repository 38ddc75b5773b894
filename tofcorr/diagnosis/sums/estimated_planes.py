r"""Planes that an importer found in the depth: nuisance parameters of the base model.

An estimated plane has absorbed part of the camera's errors. The diagnosis therefore fits every such
wall again, together with hand-eye transform and error terms, in the base fit, in each fold and
beside each effect. A wall n . x + d = 0 has three parameters: two turns of its normal and a shift
of d. For a point p, seen along the ray r, the predicted distance D changes by

.. math:: \frac{\partial D}{\partial a} = -\frac{t \cdot p}{n \cdot r}, \quad
          \frac{\partial D}{\partial d} = -\frac{1}{n \cdot r}

with the normal's tangent vector t.
"""

from dataclasses import replace

import torch
from torch import Tensor

from tofcorr.data.recording import Recording
from tofcorr.diagnosis.sums.observations import Observations
from tofcorr.errors import CalibrationDataError
from tofcorr.fit.unknown_walls import name_walls
from tofcorr.geometry.planes import plane_in_frame, tangents
from tofcorr.geometry.rays import ray_directions
from tofcorr.pixels.dataset import Dataset

# Fewest poses of a wall. A wall has three parameters and one pose determines about three, so that
# fewer poses tell hardly anything but where the wall is. As in training.
_FEWEST_POSES = 3
PER_WALL = 3
"""Parameters of a wall: two turns, radians, and a shift, metres."""


def with_numbered_walls(observations: Observations) -> Observations:
    """Return the observations that know which wall each frame shows, where planes are estimated.

    Recorded planes that were measured stay as they are: no wall is numbered.

    Raises:
        CalibrationDataError: The planes are estimated, and no robot moves, or a wall is seen from
            fewer than three poses.
    """
    recording = observations.recording
    if recording.planes != "estimated":
        return observations
    if not recording.moves:
        raise CalibrationDataError(
            f"{recording.path}: its planes are estimated from the depth (recording.yaml: planes) "
            "and no robot moves: nothing but the depth itself says where they are. Measure them, "
            "or import a checkerboard."
        )
    named = name_walls(Dataset((recording,)))
    wall = torch.from_numpy(named.of_frame)
    seen = observations.frame.unique()
    for number, name in enumerate(named.names):
        poses = len(observations.unit[seen][wall[seen] == number].unique())
        if poses < _FEWEST_POSES:
            raise CalibrationDataError(
                f"{recording.path}: its planes are estimated from the depth (recording.yaml: "
                f"planes), and '{name}' is seen from {poses} pose{'s' * (poses != 1)}; "
                f"{_FEWEST_POSES} are needed to "
                "estimate it anew. Record more, or leave its frames out."
            )
    return replace(observations, wall=wall, num_walls=len(named.names))


def wall_columns(observations: Observations, tool_from_camera: Tensor) -> Tensor:
    """Return the derivative of the predicted distance by the G walls' parameters, (M, 3G)."""
    wall = observations.wall
    assert wall is not None
    facts, frame = observations.facts, observations.frame
    rays = ray_directions(observations.recording.camera).reshape(-1, 3)[observations.pixel]
    pose = facts.world_from_tool @ tool_from_camera
    normal, offset = plane_in_frame(facts.normal_world, facts.offset, pose)
    slope = (rays * normal[frame]).sum(-1)
    distance = -offset[frame] / slope
    points = (pose[frame, :3, :3] @ rays[:, :, None])[..., 0] * distance[:, None]
    points = points + pose[frame, :3, 3]
    across = (tangents(facts.normal_world)[frame] @ points[:, :, None])[..., 0]
    own = -torch.cat([across, torch.ones_like(slope)[:, None]], dim=1) / slope[:, None]
    columns = torch.zeros(len(frame), observations.num_walls, PER_WALL, dtype=torch.float64)
    columns[torch.arange(len(frame)), wall[frame]] = own
    return columns.flatten(1)


def with_walls_moved(observations: Observations, step: Tensor) -> Observations:
    """Return the observations after a step (3G,) of the walls; recording and facts both follow."""
    wall = observations.wall
    if wall is None:
        return observations
    change = step.reshape(-1, PER_WALL)[wall]
    facts = observations.facts
    turned = facts.normal_world + (change[:, :2, None] * tangents(facts.normal_world)).sum(1)
    return with_planes(
        observations, torch.nn.functional.normalize(turned, dim=1), facts.offset + change[:, 2]
    )


def with_planes(observations: Observations, normal_world: Tensor, offset: Tensor) -> Observations:
    """Return the observations with other planes of the frames, (F, 3) and (F,) metres."""
    facts = replace(observations.facts, normal_world=normal_world, offset=offset)
    recording = _with_planes(observations.recording, normal_world, offset)
    return replace(observations, facts=facts, recording=recording)


def _with_planes(recording: Recording, normal_world: Tensor, offset: Tensor) -> Recording:
    table = replace(recording.frames, normal_world=normal_world.numpy(), offset=offset.numpy())
    return replace(recording, frames=table)
