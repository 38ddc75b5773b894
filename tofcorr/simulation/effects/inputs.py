"""What an effect may use of a recording or of a frame being simulated, and what it needs."""

from collections.abc import Callable, Hashable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import torch
from torch import Tensor

from tofcorr.conditions import condition
from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.geometry.rays import phase_from_radial_distance, unambiguous_range
from tofcorr.simulation.effects.image_filters import blur
from tofcorr.simulation.hooks import FrameFacts, FrameState

# Brightness varies where its squared second differences exceed this many times the variance of its
# noise. Chosen: four standard deviations.
_VARIES = 16.0
_OfImages = Callable[..., Tensor]
# Largest number of pixels in one batch of images. Set by hand: bounds the memory to some 100 MB.
_CHUNK_PIXELS = 500_000


@dataclass(frozen=True, kw_only=True)
class EffectInputs:
    """M chosen pixels of F frames, float64 unless stated otherwise.

    Attributes:
        camera: Intrinsics as recorded.
        modulation_frequency: Hz; None if unknown.
        tool_from_camera: Hand-eye transform, shape (4, 4).
        facts: What is known of the F frames.
        frame: Which frame a pixel belongs to, shape (M,), int64.
        pixel: Flat index row * width + column, shape (M,), int64.
        rays: Unit viewing rays in the camera frame, shape (M, 3).
        radial_distance: Predicted from geometry, never measured, shape (M,), metres.
        incidence_cosine: Shape (M,), in (0, 1].
        points_world: Shape (M, 3), metres.
        target_xy: The same points in the target's own coordinates, shape (M, 2), metres.
        amplitude: Counts, shape (M,); None if unknown.
        amplitude_images: Counts, shape (F, H, W), zero where there is no return; None if unknown.
            Float32 or float64.
        amplitude_noise: Standard deviation of the amplitude's noise where neighbouring pixels share
            noise, counts, shape (M,); None: they share none.
        distance_images: Radial distances of the same pixels, shape (F, H, W), metres.
        planes_are_measured: Whether the target's planes were measured by other means than by the
            depth itself.
        light: Amplitude that no tap has clipped, counts, shape (M,); None: only what was measured.
        normals_camera: Unit normals of any surfaces in the camera frame, shape (M, 3); None: each
            frame shows one plane, that of `facts`.
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
    amplitude_noise: Tensor | None = None
    distance_images: Tensor | None = None
    planes_are_measured: bool = True
    light: Tensor | None = None
    normals_camera: Tensor | None = None
    _remembered: dict[Hashable, Tensor] = field(default_factory=dict, repr=False, init=False)

    def of_frame(self, values: Tensor) -> Tensor:
        """Return the values of frames (F, ...) for each pixel, shape (M, ...)."""
        return values[self.frame]

    @cached_property
    def rows(self) -> Tensor:
        """Rows scaled to [-1, 1] from the top to the bottom edge, shape (M,)."""
        row = torch.div(self.pixel, self.camera.width, rounding_mode="floor")
        return 2 * row.to(self.radial_distance) / max(self.camera.height - 1, 1) - 1

    @cached_property
    def columns(self) -> Tensor:
        """Columns scaled to [-1, 1] from the left to the right edge, shape (M,)."""
        column = torch.remainder(self.pixel, self.camera.width)
        return 2 * column.to(self.radial_distance) / max(self.camera.width - 1, 1) - 1

    @cached_property
    def phase(self) -> Tensor:
        """Phase of the predicted distance, not wrapped, shape (M,), radians."""
        return phase_from_radial_distance(self.radial_distance, self.known_frequency)

    @cached_property
    def turn(self) -> Tensor:
        """Phasor of length one at the phase, shape (M,), complex."""
        return torch.polar(torch.ones_like(self.phase), self.phase)

    @property
    def known_frequency(self) -> float:
        """Modulation frequency in Hz; an effect that uses it lists it among its needs."""
        return known(self, "modulation_frequency")

    @property
    def metres_per_radian(self) -> float:
        """Distance per radian of phase."""
        return unambiguous_range(self.known_frequency) / (2 * torch.pi)

    @property
    def known_amplitude(self) -> Tensor:
        """Amplitudes in counts; an effect that uses them lists them among its needs."""
        return known(self, "amplitude")

    def signal(self) -> Tensor:
        """Return the fundamental's phasor in every chosen pixel, shape (M,), complex."""
        return torch.polar(self.known_amplitude, self.phase)

    def from_signal(self, function: _OfImages, *arguments: Hashable) -> Tensor:
        """Apply a function to images of the phasor, and return its value in the chosen pixels.

        Args:
            function: Takes complex images (B, H, W), then the arguments; returns (B, H, W, ...).
            arguments: Of the function.
        """
        return self.from_images(_from_signal, self.known_frequency, function, *arguments)

    def brightness_varies(self, sigma: float) -> Tensor:
        r"""Return where brightness varies by more than noise that neighbours share, (M,), bool.

        A camera that filters its images leaves pixels i and j a share r of their noise. The noise
        of their phasors is circular, so that the amplitude of one varies with the phase of the
        other: :math:`E\, \delta A_j \delta\phi_i = r \sigma_A^2 \sin(\phi_j - \phi_i) / A_i`. What
        depends on slopes of the measured amplitude would thus explain noise of the distance. Second
        differences decide, as they do not see the slopes of light and shade.

        Args:
            sigma: Standard deviation of the neighbourhood, a Gaussian, in pixels.
        """
        assert self.amplitude_noise is not None
        return self.from_images(_bent_square, sigma) > _VARIES * self.amplitude_noise**2

    def from_images(
        self, function: _OfImages, *arguments: Hashable, of_frames: Tensor | None = None
    ) -> Tensor:
        """Apply a function to whole images and return its value in the chosen pixels, kept.

        Args:
            function: Takes amplitudes and distances (B, H, W), then the values of these frames if
                there are any, then the arguments; returns (B, H, W, ...). Large images are given in
                single precision.
            arguments: Of the function.
            of_frames: Values of the frames, shape (F, ...).

        Returns:
            Shape (M, ...).
        """
        key = (function, *arguments)
        if key not in self._remembered:
            whole = [known(self, "amplitude_images"), known(self, "distance_images")]
            whole += [] if of_frames is None else [of_frames]
            size = whole[0][0].numel()
            step, values = max(1, _CHUNK_PIXELS // size), []
            for start in range(0, len(whole[0]), step):
                images = function(*(each[start : start + step] for each in whole), *arguments)
                inside = (self.frame >= start) & (self.frame < start + step)
                place = (self.frame[inside] - start) * size + self.pixel[inside]
                values.append(images.flatten(0, 2)[place])
            self._remembered[key] = torch.cat(values)
        return self._remembered[key]

    def remembered(self, function: _OfImages, *arguments: Hashable) -> Tensor:
        """Return `function(self, *arguments)`, computed on the first call."""
        key = (function, *arguments)
        if key not in self._remembered:
            self._remembered[key] = function(self, *arguments)
        return self._remembered[key]


def known(holder: "EffectInputs | FrameFacts", name: str) -> Any:  # noqa: ANN401 - of any attribute
    """Return what an effect uses; it lists it among its needs.

    Raises:
        ValueError: It is unknown.
    """
    value = getattr(holder, name)
    if value is None:
        raise ValueError(f"{name} is unknown; an effect needs it.")
    return value


def _from_signal(
    amplitude: Tensor, distance: Tensor, frequency: float, function: _OfImages, *more: Hashable
) -> Tensor:
    signal = torch.polar(amplitude, phase_from_radial_distance(distance, frequency))
    return function(signal, *more)


def _bent_square(amplitude: Tensor, _distance: Tensor, sigma: float) -> Tensor:
    """Return the mean square of second differences along rows and columns, blurred, (B, H, W)."""
    images = amplitude.double()
    square = torch.zeros_like(images)
    for axis in (1, 2):
        if images.shape[axis] > 2:
            second = images.diff(n=2, dim=axis).square() / 2
            square.narrow(axis, 1, second.shape[axis]).add_(second)
    return blur(square, sigma)


# The inputs from a frame that is being simulated.


def inputs_from_state(state: FrameState) -> EffectInputs:
    """Return what an effect may use of a frame that has passed stage geometry.

    Amplitudes are known from stage light on.
    """
    count = state.radial_distance.numel()
    counts = None
    if state.amplitude.numel() == count:
        counts = state.amplitude / state.electrons_per_count
    return EffectInputs(
        camera=state.camera,
        modulation_frequency=state.modulation_frequency,
        tool_from_camera=state.tool_from_camera,
        facts=state.facts.at(slice(-1, None)),
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


# What an effect can need to know before it can be tested, and whether it is known.


class Need(NamedTuple):
    """Something that an effect needs to know.

    Attributes:
        words: What it is called: the file, column or key of the recording format that holds it.
        known: Whether it is known for every frame.
        condition: Attribute of `Conditions`, where it is a condition of the frames.
        beyond_image: Why depth images of any scene do not hold it; empty where they do.
    """

    words: str
    known: Callable[[EffectInputs], bool]
    condition: str = ""
    beyond_image: str = ""


def _complete(values: Tensor | None) -> bool:
    return values is not None and bool(torch.isfinite(values).all())


def _condition(name: str) -> Need:
    """Return the need of a condition in every frame."""
    column = condition(name).column
    return Need(column, lambda inputs: _complete(getattr(inputs.facts, name)), condition=name)


def _moves(inputs: EffectInputs) -> bool:
    poses = inputs.facts.world_from_tool
    return bool((poses - poses[:1]).abs().amax() > 0)


def is_clock(times: Tensor) -> bool:
    """Return whether time stamps (F,) are times: those that merely count the frames are none."""
    counts = torch.arange(len(times), dtype=times.dtype, device=times.device)
    return bool(times.max() > times.min()) and not torch.equal(times, counts)


AMPLITUDE = Need("amplitude.npy", lambda inputs: inputs.amplitude is not None)
FREQUENCY = Need(
    "modulation_frequency_hz in recording.yaml",
    lambda inputs: inputs.modulation_frequency is not None,
)
INTEGRATION_TIME = _condition("integration_time")
ROOM_TEMPERATURE = _condition("room_temperature")
AMBIENT = _condition("ambient")
TIMESTAMP = Need(
    f"{condition('timestamp').column} of a clock",
    lambda inputs: is_clock(inputs.facts.timestamp),
    condition="timestamp",
)
ROBOT = Need(
    "poses of a moving tool",
    _moves,
    beyond_image="it belongs to the robot, not to the camera: render the scene from the true poses",
)
VELOCITY = Need(
    "velocity of the tool",
    lambda inputs: _complete(inputs.facts.tool_twist),
    beyond_image="an image does not hold how fast the camera moves",
)
# If the tool never moves, nothing shows whether target and room stay in place.
FIXED_TARGET = Need(
    "a target that stays in place",
    _moves,
    beyond_image="it belongs to the target and the room of the recording, which an image of "
    "another scene does not hold",
)
# A plane that the fit has to estimate is wherever the depth says.
MEASURED_PLANES = Need("measured planes", lambda inputs: inputs.planes_are_measured)
