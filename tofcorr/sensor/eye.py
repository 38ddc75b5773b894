"""From a rendered scene to distances along the rays and the light that returns."""

from collections.abc import Mapping
from typing import NamedTuple

import torch
from torch import Tensor, nn

from tofcorr.errors import ConfigError, FrameError
from tofcorr.geometry.ranges import refuse_other_than_tensor
from tofcorr.geometry.rays import ray_directions
from tofcorr.sensor.light import amplitude_of
from tofcorr.sensor.scene_frames import SceneFrames
from tofcorr.sensor.sensor_file import SensorFile
from tofcorr.sensor.surface import SurfaceFinder

# Fewest pixels on either side: the surface of a pixel is told by its neighbours.
_FEWEST = 2


class Scene(NamedTuple):
    """What a simulator states of frames.

    Attributes:
        true_depth: Of the camera's kind, shape (..., H, W), metres.
        amplitude: The camera's units, the same shape; None: from the reflectivity.
        reflectivity: 0 to 1, the same shape; None: the sensor's usual one.
        conditions: In SI units by name, each (B,).
    """

    true_depth: Tensor
    amplitude: Tensor | None
    reflectivity: Tensor | None
    conditions: Mapping[str, Tensor]


class Eye(nn.Module):
    """Rays and light of a sensor.

    Args:
        sensor: The camera.

    Attributes:
        rays: Unit viewing rays, shape (H, W, 3).
        radial_of_depth: Radial distance over depth, shape (H, W): 1 for radial depth.
    """

    rays: Tensor
    radial_of_depth: Tensor

    def __init__(self, sensor: SensorFile) -> None:
        super().__init__()
        self.camera = sensor.intrinsics()
        if min(self.camera.width, self.camera.height) < _FEWEST:
            raise ConfigError(
                f"camera: {self.camera.width} x {self.camera.height} pixels; a sensor compares "
                f"neighbouring pixels, and needs {_FEWEST} x {_FEWEST} at least."
            )
        self.light = sensor.light
        self.modulation_frequency = sensor.modulation_frequency_hz
        rays = ray_directions(self.camera).clone()
        slant = rays[..., 2]
        self.register_buffer("rays", rays)
        self.finder = SurfaceFinder(rays)
        scale = 1 / slant if sensor.depth_kind == "z" else torch.ones_like(slant)
        self.register_buffer("radial_of_depth", scale)

    def is_lit(self, scene: Scene) -> bool:
        """Whether the amplitude of a scene is known."""
        return scene.amplitude is not None or self.light is not None

    def forward(self, scene: Scene, *, needs_amplitude: bool) -> SceneFrames:
        """Return the frames of a scene, B of them, in the dtype of the rays.

        Raises:
            FrameError: The frames are of another size or dtype, or an amplitude is needed and
                nothing says it.
        """
        depth = scene.true_depth
        for name in ("true_depth", "amplitude", "reflectivity"):
            self._check(name, getattr(scene, name), depth)
        if not self.is_lit(scene) and (needs_amplitude or scene.reflectivity is not None):
            raise FrameError(
                "amplitude: what this sensor measures depends on the amplitude, and its file has "
                "no section 'light' that gives it from a reflectivity; pass amplitudes in the "
                "camera's units."
            )
        depth = depth.reshape(-1, *depth.shape[-2:]).to(self.rays.dtype)
        seen = torch.isfinite(depth) & (depth > 0)
        frames = SceneFrames(
            camera=self.camera,
            modulation_frequency=self.modulation_frequency,
            rays=self.rays,
            finder=self.finder,
            distance=torch.where(seen, depth * self.radial_of_depth, 1.0),
            amplitude=torch.zeros_like(depth),
            seen=seen,
            conditions=scene.conditions,
        )
        return frames.with_amplitude(torch.where(seen, self._amplitude(scene, frames), 0.0))

    def _amplitude(self, scene: Scene, frames: SceneFrames) -> Tensor:
        like = frames.distance
        if scene.amplitude is not None:
            amplitude = scene.amplitude.reshape(like.shape).to(like.dtype)
            return torch.where(torch.isfinite(amplitude), amplitude, 0.0)
        if self.light is None:
            return torch.zeros_like(like)
        if scene.reflectivity is None:
            shares = torch.full_like(like, self.light.usual_reflectivity)
        else:
            shares = scene.reflectivity.reshape(like.shape).to(like.dtype)
        cosine = frames.surface.incidence_cosine
        return amplitude_of(self.light, shares, like, cosine, frames.rays)

    def _check(self, name: str, image: Tensor | None, depth: Tensor) -> None:
        if image is None:
            return
        refuse_other_than_tensor(name, image)
        size = list(self.radial_of_depth.shape)
        if image.dim() < 2 or list(image.shape[-2:]) != size:
            raise FrameError(
                f"{name}: expected shape (..., {size[0]}, {size[1]}), the size of the camera; got "
                f"{list(image.shape)}. Render with the intrinsics of the sensor."
            )
        if image.shape != depth.shape:
            raise FrameError(
                f"{name}: expected the shape of true_depth, {list(depth.shape)}; got "
                f"{list(image.shape)}."
            )
        if not image.is_floating_point():
            raise FrameError(f"{name}: expected floating point, got {image.dtype}.")
