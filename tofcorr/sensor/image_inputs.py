"""What effects may use of whole frames, each part computed when an effect first asks for it."""

# pyright: reportIncompatibleVariableOverride=false
# Every field of `EffectInputs` is read only; here it is a property that remembers its value.

from collections.abc import Callable
from functools import cached_property

import torch
from torch import Tensor

from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.sensor.scene_frames import SceneFrames, facts_of
from tofcorr.simulation.effects.image_filters import blur
from tofcorr.simulation.effects.inputs import EffectInputs, FrameFacts


class ImageInputs(EffectInputs):
    """All pixels of B frames of any scene, M = B H W, in the dtype of the frames.

    Poses and planes, which images lack, stand for a camera at the origin. The target's coordinates
    are those of the camera. Every pixel is there, in order: nothing is gathered.

    Args:
        frames: The frames.
    """

    def __init__(self, frames: SceneFrames) -> None:
        # A frozen dataclass refuses assignment; `EffectInputs.__init__` would compute every part.
        vars(self).update(_frames=frames, _remembered={})

    @property
    def _seen(self) -> SceneFrames:
        return vars(self)["_frames"]

    @cached_property
    def camera(self) -> CameraIntrinsics:
        """Intrinsics."""
        return self._seen.camera

    @cached_property
    def modulation_frequency(self) -> float | None:
        """Hz; None if unknown."""
        return self._seen.modulation_frequency

    @cached_property
    def tool_from_camera(self) -> Tensor:
        """The identity."""
        return torch.eye(4, dtype=torch.float64)

    @cached_property
    def facts(self) -> FrameFacts:
        """The conditions of the frames, float64."""
        distance = self._seen.distance
        return facts_of(self._seen.conditions, len(distance), distance.device)

    @cached_property
    def frame(self) -> Tensor:
        """Which frame a pixel belongs to, shape (M,), int64."""
        return torch.arange(len(self._seen.distance)).repeat_interleave(self._num_pixels)

    @cached_property
    def pixel(self) -> Tensor:
        """Flat index row * width + column, shape (M,), int64."""
        return torch.arange(self._num_pixels).repeat(len(self._seen.distance))

    @cached_property
    def rows(self) -> Tensor:
        """Rows scaled to [-1, 1] from the top to the bottom edge, shape (M,)."""
        return self._of_pixels(self._scaled(-2)[:, None])

    @cached_property
    def columns(self) -> Tensor:
        """Columns scaled to [-1, 1] from the left to the right edge, shape (M,)."""
        return self._of_pixels(self._scaled(-1))

    @cached_property
    def rays(self) -> Tensor:
        """Unit viewing rays, shape (M, 3)."""
        rays = self._seen.rays
        return rays.expand(len(self._seen.distance), *rays.shape).reshape(-1, 3)

    @cached_property
    def radial_distance(self) -> Tensor:
        """Shape (M,), metres."""
        return self._seen.distance.reshape(-1)

    @cached_property
    def incidence_cosine(self) -> Tensor:
        """Shape (M,)."""
        return self._seen.surface.incidence_cosine.reshape(-1)

    @cached_property
    def points_world(self) -> Tensor:
        """In the camera frame, shape (M, 3), metres."""
        return self.radial_distance[:, None] * self.rays

    @cached_property
    def target_xy(self) -> Tensor:
        """In the camera frame, shape (M, 2), metres."""
        return self.points_world[:, :2]

    @cached_property
    def amplitude(self) -> Tensor:
        """Counts, shape (M,)."""
        return self.amplitude_images.reshape(-1)

    @cached_property
    def amplitude_images(self) -> Tensor:
        """Counts, shape (B, H, W)."""
        return self._seen.amplitude

    @cached_property
    def distance_images(self) -> Tensor:
        """Shape (B, H, W), metres; zero where nothing is."""
        return torch.where(self._seen.seen, self._seen.distance, 0.0)

    @cached_property
    def light(self) -> Tensor:
        """Amplitude that no tap has clipped, counts, shape (M,)."""
        return self.amplitude

    @cached_property
    def normals_camera(self) -> Tensor:
        """Unit normals of the surfaces, shape (M, 3)."""
        return self._seen.surface.normals().reshape(-1, 3)

    def of_frame(self, values: Tensor) -> Tensor:
        """Return the values of frames (B, ...) for each pixel, shape (M, ...)."""
        if values.is_floating_point():
            values = values.to(self._seen.distance.dtype)
        return values.repeat_interleave(self._num_pixels, dim=0)

    def signal(self) -> Tensor:
        """Return the fundamental's phasor in every pixel, shape (M,), complex."""
        return self.remembered("signal", self._computed_signal)

    def blurred_signal(self, sigma: float) -> Tensor:
        """Return the phasor image blurred by a Gaussian of `sigma` pixels, shape (M,), complex."""
        images = self.signal().reshape(self._seen.distance.shape)
        return self.remembered(
            f"signal blurred by {sigma} pixels", lambda: blur(images, sigma).reshape(-1)
        )

    def mean_signal(self) -> Tensor:
        """Return the mean phasor of the whole image, shape (M,), complex."""
        images = self.signal().reshape(self._seen.distance.shape)
        return images.mean((1, 2), keepdim=True).expand_as(images).reshape(-1)

    def _computed_signal(self) -> Tensor:
        # Cosine and sine of whole images take a third of the time of `polar`.
        phase, amplitude = self.phase, self.amplitude
        return torch.complex(amplitude * phase.cos(), amplitude * phase.sin())

    def _from_images(
        self, function: Callable[..., Tensor], of_frames: tuple[Tensor, ...]
    ) -> Tensor:
        return function(self.amplitude_images, self.distance_images, *of_frames).flatten(0, 2)

    def _scaled(self, axis: int) -> Tensor:
        """Return the places of an image axis scaled to [-1, 1], shape (H,) or (W,)."""
        like = self._seen.distance
        count = like.shape[axis]
        return 2 * torch.arange(count, dtype=like.dtype, device=like.device) / max(count - 1, 1) - 1

    def _of_pixels(self, values: Tensor) -> Tensor:
        return values.expand(self._seen.distance.shape).reshape(-1)

    @property
    def _num_pixels(self) -> int:
        return self._seen.rays[..., 0].numel()
