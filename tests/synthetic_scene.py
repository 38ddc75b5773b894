"""Walls before a camera whose errors are exactly those of an error model: no simulator involved."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from cameras import camera
from optional import present
from scipy.spatial.transform import Rotation
from torch import Generator, Tensor

from tofcorr.data.recording import FrameBatch, Recording
from tofcorr.data.table import FrameRow
from tofcorr.data.writing import write_recording
from tofcorr.error_terms.base import Domain, Interval
from tofcorr.error_terms.model import ErrorModel, ErrorModelOptions
from tofcorr.estimation.accumulator import Design, MomentAccumulator
from tofcorr.estimation.moments import ImageMoments, Parameters
from tofcorr.geometry import se3
from tofcorr.geometry.rays import plane_in_frame, ray_directions, ray_plane_distance
from tofcorr.options import resolve_options
from tofcorr.training.calibration import TrainingOptions

CAMERA = camera((12, 9), (15.0, 15.5), (5.8, 3.9), -0.08, 0.02, 0.0005, -0.0004, 0.0)
DOMAIN = Domain(
    height=9,
    width=12,
    radial_distance=Interval(0.6, 2.4),
    amplitude=Interval(50.0, 2500.0),
    normalised_amplitude=Interval(300.0, 1000.0),
)
E0, EA, EB = (
    resolve_options(TrainingOptions, name).model.to_mapping() for name in ("e0", "ea", "eb")
)


def error_model(terms: dict) -> ErrorModel:
    return ErrorModel(ErrorModelOptions.from_mapping(terms, "test"), DOMAIN)


def frame_batch(
    distance: Tensor,
    amplitude: Tensor | None,
    normal: Tensor,
    offset: Tensor,
    valid: Tensor | None = None,
) -> FrameBatch:
    """Return frames of radial distances (B, H, W) before planes; without `valid`, all are."""
    return FrameBatch(
        indices=torch.arange(len(distance)),
        radial_distance=distance,
        amplitude=amplitude,
        valid=torch.ones(distance.shape, dtype=torch.bool) if valid is None else valid,
        normal_tool=normal,
        offset_tool=offset,
    )


@dataclass(frozen=True)
class Scene:
    """Frames, and the truth behind them."""

    batch: FrameBatch
    model: ErrorModel
    truth: Parameters
    world_from_tool: Tensor

    @property
    def rays(self) -> Tensor:
        return ray_directions(CAMERA)

    def design(self, terms: dict | None = None) -> Design:
        return Design(self.model if terms is None else error_model(terms), DOMAIN, self.rays)

    def moments(self, terms: dict | None = None, weights: Tensor | None = None) -> ImageMoments:
        return MomentAccumulator(self.design(terms))(self.batch, weights)

    def residual(self, parameters: Parameters) -> Tensor:
        """Return the residuals of all pixels, shape (B, H, W)."""
        return self.residual_of_step(parameters, torch.zeros(parameters.size).double())

    def residual_of_step(self, origin: Parameters, step: Tensor) -> Tensor:
        """Return the residuals after a step, differentiable in it, shape (B, H, W)."""
        moved, batch = origin.moved(step), self.batch
        names, values = zip(*self.model.named_parameters(), strict=True)
        parts = moved.coefficients.split([one.numel() for one in values])
        shaped = (part.reshape(one.shape) for part, one in zip(parts, values, strict=True))
        given = dict(zip(names, shaped, strict=True))
        images = batch.radial_distance, batch.amplitude
        error = torch.func.functional_call(self.model, given, images)
        points = self.rays * (batch.radial_distance - error)[..., None]
        points_tool = points @ moved.tool_from_camera[:3, :3].T + moved.tool_from_camera[:3, 3]
        along = torch.einsum("bhwk,bk->bhw", points_tool, batch.normal_tool)
        return along + batch.offset_tool[:, None, None]


def make_scene(
    generator: Generator,
    terms: dict = EA,
    num_frames: int = 14,
    noise: float = 0.003,
    error_size: float = 0.01,
    invalid: float = 0.1,
) -> Scene:
    """Draw poses before a wall of bright and dark patches, and what the camera measures there.

    Args:
        generator: Source of chance.
        terms: The error model, whose coefficients are drawn.
        num_frames: Poses.
        noise: Standard deviation of the distances, metres.
        error_size: Standard deviation of the coefficients, metres.
        invalid: Share of pixels without a return, which hold NaN.
    """
    tool_from_camera = _hand_eye(generator)
    camera_poses = torch.stack([_camera_pose(generator) for _ in range(num_frames)])
    wall_normal = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand(num_frames, 3)
    wall_offset = torch.zeros(num_frames, dtype=torch.float64)
    normal_camera, offset_camera = plane_in_frame(wall_normal, wall_offset, camera_poses)
    rays = ray_directions(CAMERA)
    true_distance = ray_plane_distance(rays, normal_camera, offset_camera)
    reflectivity = 0.3 + 0.7 * _uniform(generator, *true_distance.shape).round()
    cosine = -torch.einsum("hwk,bk->bhw", rays, normal_camera)
    amplitude = 1000.0 * reflectivity * cosine / true_distance.square()
    model = error_model(terms)
    coefficients = error_size * _normal(generator, len(model.symbols()))
    model.set_coefficient_vector(coefficients)
    measured = true_distance
    with torch.no_grad():
        for _ in range(60):  # The error is a function of what is measured: a fixed point.
            measured = true_distance + model(measured, amplitude)
    measured = measured + noise * _normal(generator, *measured.shape)
    valid = _uniform(generator, *measured.shape) >= invalid
    world_from_tool = camera_poses @ se3.inverse(tool_from_camera)
    normal_tool, offset_tool = plane_in_frame(wall_normal, wall_offset, world_from_tool)
    measured, amplitude = (torch.where(valid, one, torch.nan) for one in (measured, amplitude))
    batch = frame_batch(measured, amplitude, normal_tool, offset_tool, valid)
    return Scene(batch, model, Parameters(tool_from_camera, coefficients), world_from_tool)


def write_scene(scene: Scene, path: Path, guess: Tensor | None = None, **changes: Any) -> Recording:
    """Write a scene as a recording: every second frame a checkerboard, two frames a pose.

    Args:
        scene: What to write.
        path: Folder of the recording.
        guess: The recorded hand-eye transform (4, 4); the identity if None.
        changes: Parts of the recording to replace.
    """
    rows = [
        FrameRow(
            timestamp=0.1 * frame,
            world_from_tool=pose.numpy(),
            normal_world=np.array([0.0, 0.0, 1.0]),
            offset=0.0,
            target="checkerboard" if frame % 2 else "white",
            pose_id=frame // 2,
        )
        for frame, pose in enumerate(scene.world_from_tool)
    ]
    parts = {
        "camera": CAMERA,
        "depth_kind": "radial",
        "rows": rows,
        "depth": scene.batch.radial_distance.float().numpy(),
        "amplitude": present(scene.batch.amplitude).float().numpy(),
        "tool_from_camera": None if guess is None else guess.numpy(),
    }
    write_recording(path, **(parts | changes))
    return Recording.open(path)


def without_invalid_pixels(scene: Scene) -> Scene:
    """Return the scene with harmless numbers where pixels are not valid, which stay so."""
    batch = scene.batch
    filled = replace(
        batch,
        radial_distance=torch.where(batch.valid, batch.radial_distance, 1.5),
        amplitude=torch.where(batch.valid, present(batch.amplitude), 700.0),
    )
    return replace(scene, batch=filled)


def nearby(truth: Parameters, generator: Generator, size: float = 0.01) -> Parameters:
    """Return parameters a random step away: `size` metres and radians."""
    return truth.moved(size * _normal(generator, truth.size))


def _hand_eye(generator: Generator) -> Tensor:
    twist = torch.tensor([0.05, -0.02, 0.12, 0.3, -0.2, 1.5], dtype=torch.float64)
    return se3.exp(twist + 0.05 * _normal(generator, 6))


def _camera_pose(generator: Generator) -> Tensor:
    """Return world_from_camera before the wall z = 0, looking at it tilted and rolled."""
    tilt, roll, distance = _uniform(generator, 3).tolist(), _uniform(generator, 1), 0.0
    distance = 0.8 + 1.0 * float(_uniform(generator, 1))
    angles = [180 + 50 * (tilt[0] - 0.5), 50 * (tilt[1] - 0.5), 180 * float(roll)]
    rotation = torch.from_numpy(Rotation.from_euler("xyz", angles, degrees=True).as_matrix())
    place = torch.tensor([tilt[2], -tilt[0], distance], dtype=torch.float64)
    return se3.assemble(rotation, place)


def _uniform(generator: Generator, *shape: int) -> Tensor:
    return torch.rand(*shape, generator=generator, dtype=torch.float64)


def _normal(generator: Generator, *shape: int) -> Tensor:
    return torch.randn(*shape, generator=generator, dtype=torch.float64)
