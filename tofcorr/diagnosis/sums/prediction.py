"""Distances and other inputs of effects that geometry predicts, given the hand-eye transform."""

import torch
from torch import Tensor

from tofcorr.diagnosis.sums.observations import Observations
from tofcorr.geometry.planes import plane_in_frame, ray_plane_distance
from tofcorr.geometry.rays import ray_directions
from tofcorr.simulation.effects.derivative import by_frame
from tofcorr.simulation.effects.inputs import EffectInputs
from tofcorr.simulation.scene import planes_from_world

# Whole images are predicted for this many pixels at a time. Chosen to bound memory.
_CHUNK_PIXELS = 4_000_000


def predicted_distance(observations: Observations, tool_from_camera: Tensor) -> Tensor:
    """Return the distance of the plane along the ray of each chosen pixel, shape (M,), metres."""
    normal, offset = _planes_in_camera(observations, tool_from_camera)
    slope = by_frame(observations.rays, normal[:, :, None], observations.frame)[:, 0]
    return -offset[observations.frame] / slope


def hand_eye_columns(observations: Observations, tool_from_camera: Tensor) -> tuple[Tensor, Tensor]:
    """Return the predicted distance, (M,), and its derivative by the hand-eye twist, (M, 6).

    The twist acts from the right, tool_from_camera exp(twist), translation first.
    """
    planes, offset = _planes_in_camera(observations, tool_from_camera)
    # One vector of all pixels after another: elementwise operations are fastest so.
    normal, rays = planes.T[:, observations.frame], observations.rays.T.contiguous()
    # A camera that moves by t and turns by w changes its height over the plane by n . t, and the
    # slope s = n . ray by -(w x n) . ray; the distance is -height / s.
    slope = (rays * normal).sum(0)
    distance = -offset[observations.frame] / slope
    by_rotation = torch.linalg.cross(normal, rays, dim=0) * (distance / slope)
    return distance, torch.cat([-normal / slope, by_rotation]).T


def _planes_in_camera(
    observations: Observations, tool_from_camera: Tensor
) -> tuple[Tensor, Tensor]:
    """Return normal (F, 3) and offset (F,) of each frame's plane in the camera's coordinates."""
    facts = observations.facts
    pose = facts.world_from_tool @ tool_from_camera
    return plane_in_frame(facts.normal_world, facts.offset, pose)


def effect_inputs(observations: Observations, tool_from_camera: Tensor) -> EffectInputs:
    """Return what effects may depend on: predicted geometry, measured amplitude."""
    facts, frame = observations.facts, observations.frame
    rays, pose = observations.rays, facts.world_from_tool @ tool_from_camera
    normal, offset = _planes_in_camera(observations, tool_from_camera)
    slope = by_frame(rays, normal[:, :, None], frame)[:, 0]
    distance = -offset[frame] / slope
    points = by_frame(rays, pose[:, :3, :3].mT, frame) * distance[:, None] + pose[frame, :3, 3]
    target_from_world = planes_from_world(facts.normal_world, facts.offset)
    target_xy = by_frame(points, target_from_world[:, :2, :3].mT, frame)
    return EffectInputs(
        camera=observations.recording.camera,
        modulation_frequency=observations.recording.modulation_frequency,
        tool_from_camera=tool_from_camera,
        facts=facts,
        frame=frame,
        pixel=observations.pixel,
        rays=rays,
        radial_distance=distance,
        incidence_cosine=-slope,
        points_world=points,
        target_xy=target_xy + target_from_world[frame, :2, 3],
        amplitude=observations.amplitude,
        amplitude_images=observations.amplitude_images,
        distance_images=_distance_images(observations, tool_from_camera),
        planes_are_measured=observations.wall is None,
    )


def _distance_images(observations: Observations, tool_from_camera: Tensor) -> Tensor:
    """Return predicted distances on the target and measured ones elsewhere, (F, H, W), float32."""
    images = []
    step = max(1, _CHUNK_PIXELS // observations.on_target[0].numel())
    for start in range(0, observations.num_frames, step):
        part = slice(start, start + step)
        images.append(distance_images(observations, tool_from_camera, part).float())
    return torch.cat(images)


def distance_images(
    observations: Observations, tool_from_camera: Tensor, part: slice | Tensor
) -> Tensor:
    """Return predicted distances on the target and measured ones elsewhere, of some frames."""
    predicted = predicted_images(observations, tool_from_camera, part)
    use = observations.on_target[part] & predicted.isfinite()
    return torch.where(use, predicted, observations.distance_images[part].double())


def predicted_images(
    observations: Observations,
    tool_from_camera: Tensor,
    part: slice | Tensor,
    rows: slice = slice(None),
) -> Tensor:
    """Return the distance of the plane in all pixels of some frames and rows; NaN where none."""
    normal, offset = (x[part] for x in _planes_in_camera(observations, tool_from_camera))
    return ray_plane_distance(ray_directions(observations.recording.camera)[rows], normal, offset)
