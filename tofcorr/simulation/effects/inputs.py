"""What an effect may look at: pixels of one or many frames, side by side."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import torch
from kornia.filters import gaussian_blur2d
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate

from tofcorr.geometry.intrinsics import CameraIntrinsics
from tofcorr.geometry.ranges import phase_from_radial_distance, unambiguous_range
from tofcorr.simulation.hooks import FrameState

_TWO_PI = 2 * torch.pi
# A Gaussian is cut off at this many standard deviations: less than 0.3 % of it lies beyond.
_KERNEL_SIGMAS = 3.0
# Wider Gaussians are sampled this many times a standard deviation.
_PIXELS_PER_SIGMA = 3.0
# Images are worked on in batches of so many pixels.
_CHUNK_PIXELS = 500_000


@dataclass(frozen=True, kw_only=True)
class FrameFacts:
    """What is known of every frame; None is unknown, never zero.

    Attributes:
        timestamp: Shape (F,), seconds.
        world_from_tool: Recorded poses, shape (F, 4, 4).
        normal_world: Recorded unit normals of the target, shape (F, 3).
        offset: Recorded d of n . x + d = 0, shape (F,), metres.
        integration_time: Shape (F,), seconds.
        body_temperature: Shape (F,), degrees Celsius.
        room_temperature: Shape (F,), degrees Celsius.
        ambient: Background light, shape (F,), counts.
        tool_twist: Velocity of the tool in its own frame, translation first, shape (F, 6), m/s
            and rad/s.
    """

    timestamp: Tensor
    world_from_tool: Tensor
    normal_world: Tensor
    offset: Tensor
    integration_time: Tensor | None = None
    body_temperature: Tensor | None = None
    room_temperature: Tensor | None = None
    ambient: Tensor | None = None
    tool_twist: Tensor | None = None


@dataclass(frozen=True, kw_only=True)
class EffectInputs:
    """Pixels of some frames, all float64 unless said otherwise.

    M pixels, whichever were chosen, of F frames.

    Attributes:
        camera: Intrinsics as the user knows them.
        modulation_frequency: Hz; None if unknown.
        tool_from_camera: Hand-eye transform, shape (4, 4).
        facts: What is known of the F frames.
        frame: Which frame a pixel belongs to, shape (M,), int64.
        pixel: Flat index row * width + column, shape (M,), int64.
        rays: Unit viewing rays in the camera frame, shape (M, 3).
        radial_distance: Predicted from geometry, never the pixel's own measurement, shape (M,).
        incidence_cosine: Shape (M,), in (0, 1].
        points_world: Shape (M, 3), metres.
        target_xy: The same points in the target's own coordinates, shape (M, 2), metres.
        amplitude: Counts, shape (M,); None if unknown.
        amplitude_images: Counts, shape (F, H, W), zero where there is no return; None if unknown.
            Float32 or float64.
        distance_images: Radial distances of the same pixels, shape (F, H, W), metres.
    """

    camera: CameraIntrinsics
    modulation_frequency: float | None
    tool_from_camera: Tensor
    facts: FrameFacts
    frame: Tensor
    pixel: Tensor
    rays: Tensor
    radial_distance: Tensor
    incidence_cosine: Tensor
    points_world: Tensor
    target_xy: Tensor
    amplitude: Tensor | None = None
    amplitude_images: Tensor | None = None
    distance_images: Tensor | None = None
    _remembered: dict[str, Tensor] = field(default_factory=dict, repr=False)

    def of_frame(self, values: Tensor) -> Tensor:
        """Spread values of frames (F, ...) over their pixels: shape (M, ...)."""
        return values[self.frame]

    @cached_property
    def rows(self) -> Tensor:
        """Rows scaled to [-1, 1] from the top to the bottom edge, shape (M,)."""
        row = torch.div(self.pixel, self.camera.width, rounding_mode="floor")
        return 2 * row.double() / max(self.camera.height - 1, 1) - 1

    @cached_property
    def columns(self) -> Tensor:
        """Columns scaled to [-1, 1] from the left to the right edge, shape (M,)."""
        column = torch.remainder(self.pixel, self.camera.width)
        return 2 * column.double() / max(self.camera.width - 1, 1) - 1

    @cached_property
    def phase(self) -> Tensor:
        """Phase of the predicted distance, not wrapped, shape (M,), radians."""
        return phase_from_radial_distance(self.radial_distance, self.known_frequency)

    @property
    def known_frequency(self) -> float:
        """Modulation frequency; an effect that asks for it lists it among its needs."""
        if self.modulation_frequency is None:
            raise ValueError("modulation_frequency_hz is unknown; this effect needs it.")
        return self.modulation_frequency

    @property
    def metres_per_radian(self) -> float:
        """Distance that one radian of phase stands for."""
        return unambiguous_range(self.known_frequency) / _TWO_PI

    @property
    def known_amplitude(self) -> Tensor:
        """Amplitudes; an effect that asks for them lists them among its needs."""
        if self.amplitude is None:
            raise ValueError("The amplitude is unknown; this effect needs it.")
        return self.amplitude

    def signal(self) -> Tensor:
        """Return the fundamental's phasor in every chosen pixel, shape (M,), complex128."""
        return torch.polar(self.known_amplitude, self.phase)

    def blurred_signal(self, sigma: float) -> Tensor:
        """Return the phasor image spread by a Gaussian, in the chosen pixels: (M,), complex128.

        Args:
            sigma: Standard deviation in pixels.
        """
        frequency = self.known_frequency

        def spread(amplitude: Tensor, distance: Tensor) -> Tensor:
            phase = phase_from_radial_distance(distance, frequency)
            return blur(torch.polar(amplitude, phase), sigma)

        return self.from_images(f"signal blurred by {sigma} pixels", spread).to(torch.complex128)

    def from_images(self, what: str, function: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
        """Apply a function to whole images, once, and return its value in the chosen pixels.

        Args:
            what: Names the function: it is remembered under this name.
            function: Takes amplitudes and distances (B, H, W) and returns (B, H, W, ...); large
                images come in single precision.

        Returns:
            Shape (M, ...).
        """
        return self.remembered(what, lambda: self._from_images(function))

    def remembered(self, what: str, make: Callable[[], Tensor]) -> Tensor:
        """Make a tensor the first time that it is asked for under this name."""
        if what not in self._remembered:
            self._remembered[what] = make()
        return self._remembered[what]

    def _from_images(self, function: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
        if self.amplitude_images is None or self.distance_images is None:
            raise ValueError("Amplitude images are unknown; this effect needs them.")
        step = max(1, _CHUNK_PIXELS // self.amplitude_images[0].numel())
        parts = []
        for start in range(0, len(self.amplitude_images), step):
            images = function(
                self.amplitude_images[start : start + step],
                self.distance_images[start : start + step],
            ).flatten(1, 2)
            inside = (self.frame >= start) & (self.frame < start + step)
            parts.append(images[self.frame[inside] - start, self.pixel[inside]])
        return torch.cat(parts)


def blur(images: Tensor, sigma: float) -> Tensor:
    """Spread complex or real images (F, H, W) by a Gaussian of `sigma` pixels, edges repeated.

    A wide Gaussian is applied to images averaged over squares a third of its width.
    """
    if images.is_complex():
        return torch.complex(blur(images.real, sigma), blur(images.imag, sigma))
    size = images.shape[-2:]
    square = max(1, min(int(sigma / _PIXELS_PER_SIGMA), *size))
    coarse = images[:, None]
    if square > 1:
        coarse = avg_pool2d(coarse, square, ceil_mode=True, count_include_pad=False)
    coarse = _gaussian(coarse, sigma / square)
    if square > 1:
        coarse = interpolate(coarse, scale_factor=square, mode="bilinear", align_corners=False)
    return coarse[:, 0, : size[0], : size[1]]


def _gaussian(images: Tensor, sigma: float) -> Tensor:
    half = max(1, round(_KERNEL_SIGMAS * sigma))
    half = max(0, min(half, images.shape[-1] - 1, images.shape[-2] - 1))
    width = 2 * half + 1
    return gaussian_blur2d(images, (width, width), (sigma, sigma), "replicate")


def intersect(
    rays: Tensor, frame: Tensor, world_from_camera: Tensor, normal: Tensor, offset: Tensor
) -> Tensor:
    """Return how far along each ray the plane of its frame lies.

    Args:
        rays: Viewing rays in the camera frame, shape (M, 3); need not be unit vectors, the
            result is in their lengths.
        frame: Which frame a ray belongs to, shape (M,).
        world_from_camera: Shape (F, 4, 4).
        normal: Unit normals in the world, shape (F, 3).
        offset: d of n . x + d = 0, shape (F,), metres.

    Returns:
        Shape (M,).
    """
    normal_camera = (normal[:, None, :] @ world_from_camera[:, :3, :3])[:, 0]
    height = (normal * world_from_camera[:, :3, 3]).sum(-1) + offset
    return -height[frame] / (rays * normal_camera[frame]).sum(-1)


def inputs_from_state(state: FrameState) -> EffectInputs:
    """Return what an effect may look at in a frame that the simulator has reached the light of.

    Amplitudes are there from stage light on; before it they are unknown.
    """
    count = state.radial_distance.numel()
    has_light = state.amplitude.numel() == count
    counts = state.amplitude / state.electrons_per_count if has_light else None
    return EffectInputs(
        camera=state.camera,
        modulation_frequency=state.modulation_frequency,
        tool_from_camera=state.tool_from_camera,
        facts=facts_from_state(state),
        frame=torch.zeros(count, dtype=torch.int64),
        pixel=torch.arange(count),
        rays=state.ray_directions.reshape(-1, 3),
        radial_distance=state.radial_distance.reshape(-1),
        incidence_cosine=state.incidence_cosine.reshape(-1),
        points_world=state.points_world.reshape(-1, 3),
        target_xy=state.target_xy.reshape(-1, 2),
        amplitude=None if counts is None else counts.reshape(-1),
        amplitude_images=None if counts is None else counts.nan_to_num(0.0)[None],
        distance_images=state.radial_distance.nan_to_num(0.0)[None],
    )


def facts_from_state(state: FrameState) -> FrameFacts:
    """Return the recorded circumstances of one simulated frame, F = 1."""
    known = state.conditions

    def one(value: float | None) -> Tensor | None:
        return None if value is None else torch.tensor([value], dtype=torch.float64)

    return FrameFacts(
        timestamp=torch.tensor([known.timestamp], dtype=torch.float64),
        world_from_tool=state.world_from_tool_recorded[None],
        normal_world=state.normal_world_recorded[None],
        offset=state.offset_recorded.reshape(1),
        integration_time=one(known.integration_time),
        body_temperature=one(known.body_temperature),
        room_temperature=one(known.room_temperature),
        ambient=one(known.ambient),
        tool_twist=None if state.tool_twist is None else state.tool_twist[None],
    )
