"""The interface of every effect: an equation, its coefficients, and what it needs to know.

The simulator and the diagnosis use the same class. The simulator calls its hooks at the stages of
`tofcorr.simulation.hooks`. The diagnosis uses `shift`, the change of the measured distance in
metres, and `columns`, the derivative of `shift` at zero: the effect's columns in a linear fit.
(For an effect that is never small, `columns` holds chords instead of tangents.)
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, ClassVar, NamedTuple, Self

import torch
from pydantic import create_model
from torch import Tensor

from tofcorr.geometry.rays import distance_along_rays, plane_in_frame
from tofcorr.options import FiniteNumber, Options
from tofcorr.simulation.effects.inputs import EffectInputs, Need, inputs_from_state
from tofcorr.simulation.effects.numerics import by_frame, by_parameters
from tofcorr.simulation.hooks import Effect, FrameFacts, FrameState


class Coefficient(NamedTuple):
    """One linear parameter of an effect.

    Attributes:
        name: Key in a simulator's YAML.
        unit: For people.
        prior_sd: Standard deviation of its prior around zero, in `unit`. Unless a comment says
            otherwise it was set by hand, from the sizes that the effect's `source` reports.
    """

    name: str
    unit: str
    prior_sd: float


class CatalogueEffect(Effect, ABC):
    """An effect with named coefficients, for simulation and for fitting.

    Class attributes:
        name: Its name in `diagnosis.json` and in a simulator's YAML.
        summary: What it is, in one line.
        source: Where the equation is from.
        remedy: What to record to tell it from other effects, in one line.
        needs: What must be known to test it.
        shape_type: Options of the constants that are not linear: time constants, widths, levels.
        linear: Whether the columns hold at any strength. If not, a fit computes them again at the
            fitted coefficients.
        contains: Names of the effects whose every shift this effect can describe as well.
        refines: Groups of error terms (`Term.group`) of which this effect is a finer form.
        of_frame: Whether the shift is the same in all pixels of a frame.
        fixed_terms: The coefficients, where they do not depend on the shape.
        prior: Standard deviation of the priors of its main coefficients, where `terms` names them.
        form_error: What a real effect of this kind may leave of itself, as a share of what these
            columns explain of it (root mean squares): no two lenses, rooms or robots are alike. At
            0.5 they explain four fifths of its squares, if it is as usual.
        reads_light: Whether it reads the light that reached a clipped pixel, not the amplitude.
    """

    summary: ClassVar[str] = ""
    source: ClassVar[str] = ""
    remedy: ClassVar[str] = ""
    needs: ClassVar[tuple[Need, ...]] = ()
    shape_type: ClassVar[type[Options]] = Options
    fixed_terms: ClassVar[tuple[Coefficient, ...]] = ()
    linear: ClassVar[bool] = False
    contains: ClassVar[tuple[str, ...]] = ()
    refines: ClassVar[tuple[str, ...]] = ()
    of_frame: ClassVar[bool] = False
    prior: ClassVar[float] = 0.02
    form_error: ClassVar[float] = 0.65
    reads_light: ClassVar[bool] = False

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

    of_frame = True

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
            moved = self.moved(inputs.facts, at)
            return torch.cat(plane_in_camera(inputs, moved), dim=1).flatten()

        frame, rays = inputs.frame, inputs.rays
        by_plane = by_parameters(plane, coefficients).reshape(len(inputs.facts.offset), 4, -1)
        normal, height = plane_in_camera(inputs, self.moved(inputs.facts, coefficients))
        along = (rays * normal[frame]).sum(-1, keepdim=True)
        values = torch.cat([rays * (height[frame] / along**2), -1 / along], dim=1)
        return by_frame(values, by_plane, frame)


def plane_in_camera(inputs: EffectInputs, facts: FrameFacts) -> tuple[Tensor, Tensor]:
    """Return the target's normal (F, 3) and offset (F, 1) in the camera frame."""
    pose = facts.world_from_tool @ inputs.tool_from_camera
    normal, height = plane_in_frame(facts.normal_world, facts.offset, pose)
    return normal, height[:, None]


def distance_to(inputs: EffectInputs, facts: FrameFacts) -> Tensor:
    """Return how far along each ray the plane of its frame is, shape (M,), metres."""
    pose = facts.world_from_tool @ inputs.tool_from_camera
    return distance_along_rays(inputs.rays, inputs.frame, pose, facts.normal_world, facts.offset)


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
