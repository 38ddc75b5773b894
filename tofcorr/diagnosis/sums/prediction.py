"""Distances and other inputs of effects that geometry predicts, given the hand-eye transform."""

import torch
from torch import Tensor

from tofcorr.diagnosis.sums.observations import Observations
from tofcorr.diagnosis.sums.robust_weights import MAD_TO_SIGMA
from tofcorr.geometry.planes import plane_in_frame, ray_plane_distance
from tofcorr.geometry.rays import ray_directions
from tofcorr.simulation.effects.derivative import by_frame
from tofcorr.simulation.effects.inputs import EffectInputs
from tofcorr.simulation.scene import planes_from_world

# Whole images are predicted for this many pixels at a time. Chosen to bound memory.
_CHUNK_PIXELS = 4_000_000
# Beside the mask a pixel shows the target's plane if it is off by less than this many robust
# standard deviations. Chosen, as in the noise estimate.
_CLIP = 6.0
# Pixels of a frame that its offset and spread are taken from, at most. Chosen to bound the time.
_MOST_OF_FRAME = 20_000


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
    """Return predicted distances on the target's plane and measured ones elsewhere, of some frames.

    Masks leave out parts of the plane. There too the prediction is taken: measured neighbours would
    bring in the noise that a filtering camera lets pixels share.
    """
    predicted = predicted_images(observations, tool_from_camera, part)
    measured = observations.distance_images[part].double()
    use = observations.on_target[part]
    beside = _on_plane(observations, measured - predicted, part)
    return torch.where((use | beside) & predicted.isfinite(), predicted, measured)


def _on_plane(observations: Observations, off: Tensor, part: slice | Tensor) -> Tensor:
    """Return which pixels are off the plane (F, H, W), metres, by no more than those on target.

    Noise grows as pixels get darker; up to as much as the amplitude falls.
    """
    returned = observations.distance_images[part] > 0
    use = observations.on_target[part] & returned
    middle = _median(off, use)
    bound = _CLIP * MAD_TO_SIGMA * _median((off - middle).abs(), use)
    if observations.amplitude_images is not None:
        amplitude = observations.amplitude_images[part].double()
        returned = returned & (amplitude > 0)
        bound = bound * (_median(amplitude, use) / amplitude).clamp(min=1.0)
    return returned & ((off - middle).abs() < bound)


def _median(images: Tensor, use: Tensor) -> Tensor:
    """Return the median of used pixels of each image, (F, 1, 1); NaN where there are none."""
    step = max(1, images[0].numel() // _MOST_OF_FRAME)
    chosen = torch.where(use, images, torch.nan).flatten(1)[:, ::step]
    return chosen.nanmedian(1).values[:, None, None]


def predicted_images(
    observations: Observations,
    tool_from_camera: Tensor,
    part: slice | Tensor,
    rows: slice = slice(None),
) -> Tensor:
    """Return the distance of the plane in all pixels of some frames and rows; NaN where none."""
    normal, offset = (x[part] for x in _planes_in_camera(observations, tool_from_camera))
    return ray_plane_distance(ray_directions(observations.recording.camera)[rows], normal, offset)
