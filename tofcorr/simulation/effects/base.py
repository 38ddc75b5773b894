"""What an effect is: an equation, its coefficients, what it may use, and what it needs to know.

The simulator and the diagnosis use the same class. The simulator calls its hooks at the stages of
`tofcorr.simulation.hooks`. The diagnosis uses `shift`, the change of the measured distance in
metres, and `columns`, the derivative of `shift` at zero: the effect's columns in a linear fit.
(For an effect that is never small, `columns` holds chords instead of tangents.)
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar, NamedTuple, Self

import torch
from kornia.filters import gaussian_blur2d
from pydantic import create_model
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate

from tofcorr.conditions import condition
from tofcorr.data.recording import CHUNK_PIXELS
from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.geometry.rays import (
    phase_from_radial_distance,
    unambiguous_range,
)
from tofcorr.geometry.se3 import by_frame
from tofcorr.options import STRAY, FiniteNumber, Options
from tofcorr.simulation.hooks import Effect, FrameFacts, FrameState

# Long: every effect needs all of it, and its parts call one another.

_OfImages = Callable[..., Tensor]


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
            step, values = max(1, CHUNK_PIXELS // size), []
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


def inputs_from_state(state: FrameState) -> EffectInputs:
    """Return what an effect may use of a frame that has passed stage geometry.

    Amplitudes are known from stage light on.
    """
    count = state.radial_distance.numel()
    counts = state.amplitude / state.electrons_per_count if state.amplitude.numel() else None
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


def _given(words: str, name: str) -> Need:
    """Return the need of an attribute of `EffectInputs`."""
    return Need(words, lambda inputs: getattr(inputs, name) is not None)


AMPLITUDE = _given("amplitude.npy", "amplitude")
FREQUENCY = _given("modulation_frequency_hz in recording.yaml", "modulation_frequency")
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


# The effect itself, and the kinds of it.


class Coefficient(NamedTuple):
    """One linear parameter of an effect.

    Attributes:
        name: Key in a simulator's YAML.
        unit: For people.
        prior_sd: Standard deviation of its prior around zero, in `unit`. Unless a comment says
            otherwise it was set by hand, from the sizes that the effect's source reports.
    """

    name: str
    unit: str
    prior_sd: float


def terms_in(unit: str, prior_sds: Mapping[str, float]) -> tuple[Coefficient, ...]:
    """Return coefficients of one unit by their names and the deviations of their priors."""
    return tuple(Coefficient(name, unit, prior_sd) for name, prior_sd in prior_sds.items())


ErrorElsewhere = Callable[[Tensor, Tensor], Tensor]
"""Of frames and pixels (N,): the camera's own error there, metres (N,); NaN on the target."""


class CatalogueEffect(Effect, ABC):
    """An effect with named coefficients, for simulation and for fitting.

    Its docstring says where the equation is from. A class is declared with `shape`, the type of its
    options: the constants that are not linear, such as time constants, widths, levels.

    Class attributes:
        name: Its name in `diagnosis.json` and in a simulator's YAML.
        summary: What it is, in one line.
        remedy: What to record to tell it from other effects, in one line.
        needs: What must be known to test it.
        shape_type: The type of its options.
        linear: Whether the columns hold at any strength. If not, a fit computes them again at the
            fitted coefficients.
        contains: Names of the effects whose every shift this effect can describe as well.
        refines: Groups of error terms (`Term.group`) of which this effect is a finer form.
        fixed_terms: The coefficients, where they do not depend on the shape.
        prior: Standard deviation of the priors of its main coefficients, where `terms` names them.
        form_error: What a real effect of this kind may leave of itself, as a share of what these
            columns explain of it (root mean squares): no two lenses, rooms or robots are alike. At
            0.5 they explain four fifths of its squares, if it is as usual.
        reads_light: Whether it reads the light that reached a clipped pixel, not the amplitude.
    """

    summary: ClassVar[str] = ""
    remedy: ClassVar[str] = ""
    needs: ClassVar[tuple[Need, ...]] = ()
    shape_type: ClassVar[type[Options]] = Options
    fixed_terms: ClassVar[tuple[Coefficient, ...]] = ()
    linear: ClassVar[bool] = False
    contains: ClassVar[tuple[str, ...]] = ()
    refines: ClassVar[tuple[str, ...]] = ()
    prior: ClassVar[float] = 0.02
    form_error: ClassVar[float] = 0.8
    reads_light: ClassVar[bool] = False

    def __init_subclass__(cls, shape: type[Options] | None = None) -> None:
        """Keep the type of the options; without one it is that of the base class."""
        super().__init_subclass__()
        cls.shape_type = shape or cls.shape_type

    def __init__(self, shape: Options, coefficients: Tensor | None = None) -> None:
        self.shape: Any = shape
        count = len(self.terms(shape))
        given = torch.zeros(count) if coefficients is None else coefficients
        if given.shape != (count,):
            raise ValueError(f"{self.name}: expected {count} coefficients: {self.terms(shape)}.")
        self.coefficients = given.detach().double()

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any], where: str) -> Self:
        """Build the effect from constants and coefficients; missing coefficients are zero.

        Raises:
            ConfigError: A key is unknown or a value is not a number.
        """
        known = cls.shape_type.model_fields.keys()
        shape = cls.shape_type.from_mapping({k: values[k] for k in values.keys() & known}, where)
        fields: dict[str, Any] = {term.name: (FiniteNumber, 0.0) for term in cls.terms(shape)}
        entry = create_model("Entry", __base__=cls.shape_type, **fields).from_mapping(values, where)
        given = [getattr(entry, name) for name in fields]
        return cls(shape, torch.tensor(given, dtype=torch.float64))

    @classmethod
    def for_recording(cls, inputs: EffectInputs) -> Self:
        """Return the effect with all coefficients zero and constants chosen for a recording."""
        return cls(cls.shape_type())  # Every shape has defaults.

    @classmethod
    def forms(cls, inputs: EffectInputs) -> tuple[Self, ...]:
        """Return the effect in each form that it may have in a recording, all coefficients zero."""
        return (cls.for_recording(inputs),)

    @property
    def depends_on_pose(self) -> bool:
        """Whether it changes with the camera's pose by much more than with distances alone."""
        return False

    def again(self, inputs: EffectInputs, error: ErrorElsewhere) -> Self:
        """Return the same form with the constants that a better fit shows.

        Args:
            inputs: As of `forms`, at that fit; the coefficients are those fitted.
            error: Of the camera, elsewhere than on the target.
        """
        del inputs, error
        return self

    @property
    def said(self) -> str:
        """What it is in this form, in one line."""
        return self.summary

    @classmethod
    def missing(cls, inputs: EffectInputs) -> list[str]:
        """Return the words of what the effect needs and the recording lacks."""
        return [need.words for need in cls.needs if not need.known(inputs)]

    @classmethod
    def terms(cls, shape: Any) -> tuple[Coefficient, ...]:  # noqa: ANN401 - each its own shape
        """Return the coefficients of the effect with these constants, in order."""
        del shape
        return cls.fixed_terms

    @abstractmethod
    def shift(self, inputs: EffectInputs, coefficients: Tensor) -> Tensor:
        """Return the change of the measured radial distance, shape (M,), metres.

        Args:
            inputs: The M pixels.
            coefficients: Shape (K,), differentiable.
        """

    def columns(self, inputs: EffectInputs) -> Tensor:
        """Return the effect's columns in a linear fit, shape (M, K), metres: `slope` at zero."""
        return self.slope(inputs, torch.zeros_like(self.coefficients))

    def scaled_columns(self, inputs: EffectInputs) -> Tensor:
        """Return the columns at one prior standard deviation, shape (M, K), metres."""
        return self.columns(inputs) * self.prior_sd()

    def slope(self, inputs: EffectInputs, coefficients: Tensor) -> Tensor:
        """Return the derivative of `shift` by the coefficients (K,), shape (M, K), metres."""
        return by_parameters(lambda at: self.shift(inputs, at), coefficients)

    def prior_sd(self) -> Tensor:
        """Return the standard deviations of the coefficients' priors, shape (K,)."""
        deviations = [term.prior_sd for term in self.terms(self.shape)]
        return torch.tensor(deviations, dtype=torch.float64)

    def with_coefficients(self, coefficients: Tensor) -> Self:
        """Return the same effect with other coefficients."""
        return type(self)(self.shape, coefficients)

    def in_other_recordings(self) -> "CatalogueEffect":
        """Return the effect without what belongs to the moments of the recording it was fitted to.

        An effect that has such a part drops it here.
        """
        return self

    def to_mapping(self) -> dict[str, Any]:
        """Return name, constants and coefficients: an entry of a simulator's YAML."""
        names = [term.name for term in self.terms(self.shape)]
        values = dict(zip(names, self.coefficients.tolist(), strict=True))
        return {"name": self.name, **self.shape.to_mapping(), **values}


class LinearEffect(CatalogueEffect):
    """An effect whose shift is a weighted sum of known functions, its columns."""

    linear = True

    @abstractmethod
    def columns(self, inputs: EffectInputs) -> Tensor:
        """Return the functions, shape (M, K), metres per unit of the coefficients."""

    def slope(self, inputs: EffectInputs, coefficients: Tensor) -> Tensor:
        """Return the functions: the shift is linear everywhere, shape (M, K)."""
        del coefficients
        return self.columns(inputs)

    def shift(self, inputs: EffectInputs, coefficients: Tensor) -> Tensor:
        """Return the sum of the functions, shape (M,), metres."""
        return self.columns(inputs) @ coefficients


class LinearDelay(LinearEffect):
    """An effect that delays the signal by a weighted sum of known functions, its columns."""

    def on_delay(self, state: FrameState) -> None:
        """Add the shift to the delay of each pixel."""
        add_delay(state, self.shift(inputs_from_state(state), self.coefficients))


def add_delay(state: FrameState, shift: Tensor) -> None:
    """Delay the signal of every pixel of a simulated frame, by metres (H W,) or ()."""
    state.delay = state.delay + shift.expand(state.delay.numel()).reshape(state.delay.shape)


class FrameEffect(CatalogueEffect):
    """A delay that is the same in all pixels of a frame; it may depend on the frames before."""

    @abstractmethod
    def shifts(self, facts: FrameFacts, coefficients: Tensor) -> Tensor:
        """Return the shift of each frame, shape (F,), metres."""

    def shift(self, inputs: EffectInputs, coefficients: Tensor) -> Tensor:
        """Return the shift of each pixel's frame, shape (M,), metres."""
        return inputs.of_frame(self.shifts(inputs.facts, coefficients))

    def on_delay(self, state: FrameState) -> None:
        """Delay the frame, given those before it."""
        add_delay(state, self.shifts(state.facts, self.coefficients)[-1])


class GeometryEffect(CatalogueEffect):
    """An effect that moves camera or target, so that the rays meet the target elsewhere."""

    @abstractmethod
    def moved(self, facts: FrameFacts, coefficients: Tensor) -> FrameFacts:
        """Return where tool and target truly are, instead of where they were recorded.

        Frames of which it is not known how they move stay where they are.
        """

    def on_pose(self, state: FrameState) -> None:
        """Move tool and target."""
        if not bool(self.coefficients.any()):
            return
        here = replace(
            state.facts.at(slice(-1, None)),
            world_from_tool=state.world_from_tool[None],
            normal_world=state.normal_world[None],
            offset=state.offset[None],
        )
        moved = self.moved(here, self.coefficients)
        state.world_from_tool = moved.world_from_tool[0]
        state.normal_world, state.offset = moved.normal_world[0], moved.offset[0]

    def shift(self, inputs: EffectInputs, coefficients: Tensor) -> Tensor:
        """Return how much farther the rays meet the true plane, shape (M,), metres."""
        true = self.moved(inputs.facts, coefficients)
        return distance_to(inputs, true) - distance_to(inputs, inputs.facts)

    def slope(self, inputs: EffectInputs, coefficients: Tensor) -> Tensor:
        """Return the derivative of `shift`, shape (M, K): planes are differentiated by frame.

        With the plane's normal n and height h in the camera frame, d = -h / (v . n) along ray v.
        """

        def plane(at: Tensor) -> Tensor:
            normal, height = self.moved(inputs.facts, at).planes_seen(inputs.tool_from_camera)
            return torch.cat([normal, height[:, None]], dim=1).flatten()

        frame, rays = inputs.frame, inputs.rays
        by_plane = by_parameters(plane, coefficients).reshape(len(inputs.facts.offset), 4, -1)
        moved = self.moved(inputs.facts, coefficients)
        normal, height = moved.planes_seen(inputs.tool_from_camera)
        along = (rays * normal[frame]).sum(-1, keepdim=True)
        values = torch.cat([rays * (height[frame, None] / along**2), -1 / along], dim=1)
        return by_frame(values, by_plane, frame)


def distance_to(inputs: EffectInputs, facts: FrameFacts) -> Tensor:
    """Return how far along each ray the plane of its frame is, shape (M,), metres."""
    normal, height = facts.planes_seen(inputs.tool_from_camera)
    return -inputs.of_frame(height) / (inputs.rays * inputs.of_frame(normal)).sum(-1)


class SignalEffect(CatalogueEffect):
    r"""An effect that adds shares of light to the signal of each pixel.

    .. math:: \Delta d = \frac{c}{4 \pi f} \arg \Bigl(1 + \sum_k c_k s_k\Bigr)

    with the signal s_k of each coefficient relative to the direct light.
    """

    @abstractmethod
    def shares(self, inputs: EffectInputs) -> Tensor:
        """Return s_k, shape (M, K), complex."""

    def shift(self, inputs: EffectInputs, coefficients: Tensor) -> Tensor:
        """Return the error of the phase as distance, shape (M,), metres."""
        shares = self.shares(inputs)
        light = torch.view_as_real(1 + shares @ coefficients.to(shares.dtype))
        return inputs.metres_per_radian * torch.atan2(light[..., 1], light[..., 0])

    def slope(self, inputs: EffectInputs, coefficients: Tensor) -> Tensor:
        """Return the derivative of `shift`: of the angle by the shares, shape (M, K)."""
        shares = self.shares(inputs)
        light = 1 + shares @ coefficients.to(shares.dtype)
        return inputs.metres_per_radian * (shares / light[:, None]).imag


# What the equations of several effects share: derivatives, phases, ranges, blur.


def by_parameters(function: Callable[[Tensor], Tensor], at: Tensor) -> Tensor:
    """Return the derivatives of a function's values (M,) by its parameters (K,), shape (M, K).

    The gradient of u . f is linear in u, so that its own derivative by u is what is asked for. Each
    of the K columns then takes one pass backwards, and the function is evaluated once. (torch's
    forward mode evaluates it K times, and imports torch.compile, which takes as long as torch.)

    Args:
        function: Takes parameters (K,) and returns values (M,); differentiable twice by torch.
        at: Where to differentiate, shape (K,).
    """
    with torch.enable_grad():
        parameters = at.detach().clone().requires_grad_()
        values = function(parameters)
        if not values.requires_grad:
            return values.new_zeros(*values.shape, len(at))
        u = torch.zeros_like(values, requires_grad=True)
        # Sums and single numbers: given weights, torch would import SymPy to compare their shape.
        (gradient,) = torch.autograd.grad((values * u).sum(), parameters, create_graph=True)
        columns = [
            torch.autograd.grad(one, u, retain_graph=True, materialize_grads=True)[0]
            for one in gradient.unbind()
        ]
    return torch.stack(columns, dim=-1)


def phase_difference(signal: Tensor, own: Tensor) -> Tensor:
    """Return the phase of complex signals (M,) less that of others, radians; 0 without light.

    A signal of zero has no phase, and its derivative would be no number.
    """
    product = signal * own.conj()
    # Apart and in one piece each: `angle` of complex numbers takes three times as long.
    return torch.atan2(product.imag.contiguous(), product.real + (product == 0))


def inner_range(values: Tensor, beyond: float = STRAY) -> tuple[float, float]:
    """Return the ends of what values (M,) lie between, but for a share of them at either end."""
    ordered, last = values.sort().values, len(values) - 1
    return float(ordered[int(beyond * last)]), float(ordered[int((1 - beyond) * last)])


def side_by_side(columns: list[Tensor]) -> Tensor:
    """Return columns (M,) as a matrix (M, K), each of them in one piece of memory."""
    return torch.stack(columns).movedim(0, -1)


# Half width of the kernel in standard deviations: 0.3 % of a Gaussian lies beyond 3. As many
# samples has a standard deviation; the tests of `blur` bound what that changes in a smooth image.
_SIGMAS = 3.0


def blur(images: Tensor, sigma: float) -> Tensor:
    """Blur complex or real images (F, H, W) by a Gaussian of `sigma` pixels, edges repeated.

    A wide Gaussian is applied to images averaged over squares of a third of `sigma`.
    """
    if images.is_complex():
        return torch.complex(blur(images.real, sigma), blur(images.imag, sigma))
    size = images.shape[-2:]
    square = max(1, min(int(sigma / _SIGMAS), *size))
    wide = images[:, None].contiguous()
    if square > 1:
        wide = avg_pool2d(wide, square, ceil_mode=True, count_include_pad=False)
    side = 2 * max(1, round(_SIGMAS * sigma / square)) + 1
    wide = gaussian_blur2d(wide, side, (sigma / square, sigma / square), border_type="replicate")
    if square > 1:
        wide = interpolate(wide, scale_factor=square, mode="bilinear", align_corners=False)
    return wide[:, 0, : size[0], : size[1]]
