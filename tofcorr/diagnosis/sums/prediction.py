"""Distances and other inputs of effects that geometry predicts, given the hand-eye transform."""

import torch
from torch import Tensor

from tofcorr.diagnosis.sums.observations import Observations
from tofcorr.geometry.planes import distance_along_rays, plane_in_frame, ray_plane_distance
from tofcorr.geometry.rays import ray_directions
from tofcorr.simulation.effects.inputs import EffectInputs
from tofcorr.simulation.scene import planes_from_world

# Whole images are predicted for this many pixels at a time. Chosen to bound memory.
_CHUNK_PIXELS = 4_000_000


def predicted_distance(observations: Observations, tool_from_camera: Tensor) -> Tensor:
    """Return the distance of the plane along the ray of each chosen pixel, shape (M,), metres."""
    facts = observations.facts
    rays = ray_directions(observations.recording.camera).reshape(-1, 3)[observations.pixel]
    pose = facts.world_from_tool @ tool_from_camera
    return distance_along_rays(rays, observations.frame, pose, facts.normal_world, facts.offset)


def hand_eye_columns(observations: Observations, tool_from_camera: Tensor) -> Tensor:
    """Return the derivative of the predicted distance by the hand-eye twist, shape (M, 6).

    The twist acts from the right, tool_from_camera exp(twist), translation first.
    """
    facts = observations.facts
    rays = ray_directions(observations.recording.camera).reshape(-1, 3)[observations.pixel]
    pose = facts.world_from_tool @ tool_from_camera
    normal = (facts.normal_world[:, None, :] @ pose[:, :3, :3])[:, 0]
    distance = distance_along_rays(rays, observations.frame, pose, facts.normal_world, facts.offset)
    # A camera that moves by t and turns by w changes its height over the plane by n . t, and the
    # slope s = n . ray by -(w x n) . ray; the distance is -height / s.
    normal = normal[observations.frame]
    slope = (rays * normal).sum(-1, keepdim=True)
    by_rotation = distance[:, None] * torch.linalg.cross(normal, rays) / slope
    return torch.cat([-normal / slope, by_rotation], dim=-1)


def effect_inputs(observations: Observations, tool_from_camera: Tensor) -> EffectInputs:
    """Return what effects may depend on: predicted geometry, measured amplitude."""
    facts, frame = observations.facts, observations.frame
    rays = ray_directions(observations.recording.camera).reshape(-1, 3)[observations.pixel]
    pose = facts.world_from_tool @ tool_from_camera
    distance = distance_along_rays(rays, frame, pose, facts.normal_world, facts.offset)
    points = (pose[frame, :3, :3] @ rays[:, :, None])[..., 0] * distance[:, None]
    points = points + pose[frame, :3, 3]
    normal_camera = (facts.normal_world[:, None, :] @ pose[:, :3, :3])[:, 0]
    target_from_world = planes_from_world(facts.normal_world, facts.offset)
    target_xy = (target_from_world[frame, :2, :3] @ points[:, :, None])[..., 0]
    return EffectInputs(
        camera=observations.recording.camera,
        modulation_frequency=observations.recording.modulation_frequency,
        tool_from_camera=tool_from_camera,
        facts=facts,
        frame=frame,
        pixel=observations.pixel,
        rays=rays,
        radial_distance=distance,
        incidence_cosine=-(rays * normal_camera[frame]).sum(-1),
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
    facts = observations.facts
    pose = facts.world_from_tool[part] @ tool_from_camera
    normal, offset = plane_in_frame(facts.normal_world[part], facts.offset[part], pose)
    return ray_plane_distance(ray_directions(observations.recording.camera)[rows], normal, offset)
