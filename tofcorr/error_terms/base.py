"""What an error term is: options, coefficients, and the functions they multiply."""

import json
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from tofcorr.conditions import CONDITIONS
from tofcorr.error_terms.bases import Axis, ScaledPolynomial
from tofcorr.error_terms.domain import Domain, Variable
from tofcorr.errors import CalibrationDataError, StateError
from tofcorr.options import Options

Strength = float | str
"""Weight of a term's roughness in the loss: a number, or "auto": by cross-validation."""


class DescribedOptions(Options):
    """Options that decide which functions a module computes.

    Attributes:
        needs: What the module reads besides the measured distance: an attribute of a recording or
            of its frame table, such as `amplitude` or `integration_time`.
        found_in_data: The options that may say `auto`. A fit replaces them by what it found; they
            never change the set of functions.
    """

    needs: ClassVar[tuple[str, ...]] = ()
    found_in_data: ClassVar[tuple[str, ...]] = ()

    @property
    def needs_amplitude(self) -> bool:
        """Whether the module reads the amplitude."""
        return "amplitude" in self.needs

    def is_open(self, option: str) -> bool:
        """Whether this kind has an option of this name, and it says `auto`."""
        return option in self.found_in_data and getattr(self, option) == "auto"

    def structure(self) -> dict[str, Any]:
        """Return the options that fix the set of functions: all but those found in data."""
        values = self.to_mapping()
        return {key: values[key] for key in values if key not in self.found_in_data}


class BaseTermOptions(DescribedOptions):
    """Base of the options of every kind of error term.

    Attributes:
        kind: The term's name in YAML.
        grows_with: The option that only adds functions when it is raised, such as the degree of a
            polynomial; None if every option changes the functions. A larger term of such a family
            contains the smaller ones.
        has_columns: Whether the term is linear in a few coefficients, which the moments estimate.
    """

    kind: Any  # A literal in every kind.
    grows_with: ClassVar[str | None] = None
    has_columns: ClassVar[bool] = True

    def family(self) -> str:
        """Return what all terms of a nested family share, as text that can be compared."""
        values = self.to_mapping()
        shared = {key: values[key] for key in values if key != self.grows_with}
        return json.dumps(shared, sort_keys=True)

    def size_in_family(self) -> int:
        """Return the value of `grows_with`; 0 for a kind without families."""
        return 0 if self.grows_with is None else int(getattr(self, self.grows_with))


class DescribedModule(nn.Module):
    """A module that stores a description of itself in its `state_dict`.

    All that the output depends on is a parameter, a buffer, or part of the description. Parameters
    and buffers are loaded; the description must be equal.
    """

    def description(self) -> dict[str, Any]:
        """Return what a state must agree on to be loaded, as plain values."""
        raise NotImplementedError

    def get_extra_state(self) -> Tensor:
        """Return the description as JSON in a tensor of bytes.

        A tensor, so that every value of a `state_dict` is one.
        """
        return encode(self.description())

    def set_extra_state(self, state: Tensor) -> None:
        """Refuse the state of a module that computes something else.

        Raises:
            StateError: The description differs; the message names the first difference.
        """
        self._require_same(state)

    def _description_in(self, state: Tensor) -> dict[str, Any]:
        """Return the description that `get_extra_state` of a module of this class stored."""
        return decode(state)

    def load_state_dict(
        self, state_dict: Mapping[str, Any], strict: bool = True, assign: bool = False
    ) -> Any:  # noqa: ANN401 - torch's own named tuple
        """Load a state; refuse that of a module that computes something else untouched.

        Raises:
            StateError: The description differs; the message names the first difference.
        """
        if "_extra_state" in state_dict:
            self._require_same(state_dict["_extra_state"])
        return super().load_state_dict(state_dict, strict=strict, assign=assign)

    def _require_same(self, state: Tensor) -> None:
        require_equal(self._description_in(state), self.description(), type(self).__name__)

    def register_number(self, name: str, value: float, *, persistent: bool = True) -> None:
        """Keep a number as a buffer of shape (), float64; in the state, if persistent."""
        number = torch.tensor(float(value), dtype=torch.float64)
        self.register_buffer(name, number, persistent=persistent)


def encode(values: dict[str, Any]) -> Tensor:
    """Return plain values as JSON in a tensor of bytes, uint8."""
    return torch.tensor(list(json.dumps(values).encode()), dtype=torch.uint8)


def decode(state: Tensor) -> dict[str, Any]:
    """Return the plain values that `encode` stored."""
    return json.loads(bytes(state.tolist()).decode())


def require_equal(stored: dict[str, Any], own: dict[str, Any], name: str) -> None:
    """Refuse a stored description that differs from a module's own.

    Raises:
        StateError: The message names the first difference.
    """
    for key in dict.fromkeys([*own, *stored]):
        expected, found = own.get(key), stored.get(key)
        if found != json.loads(json.dumps(expected)):
            raise StateError(
                f"{name}: the state is of another model: its '{key}' is {found}, "
                f"this module's is {expected}. Build the module as the saved one was built."
            )


class Term(DescribedModule, ABC):
    """Base of all terms with coefficients: a vector (K,) that starts at zero, and its names.

    Numbers that come from the calibrated ranges, such as centres and half-widths, are buffers:
    `register_number` keeps them. A state that is loaded brings its own ranges along.

    Args:
        options: The options of the term's kind.
        group: Under which heading the coefficients are reported.
        symbols: The names of the coefficients, unique within a model.

    Attributes:
        coefficients: Shape (K,), metres.
        strength: Weight of `roughness` in the loss, or "auto".
    """

    group: str
    symbols: list[str]
    strength: Strength

    def __init__(self, options: BaseTermOptions, group: str, symbols: list[str]) -> None:
        super().__init__()
        self.options = options
        self.group = group
        self.symbols = symbols
        self.strength = getattr(options, "strength", 0.0)
        self.coefficients = nn.Parameter(torch.zeros(len(symbols), dtype=torch.float64))

    def set_options(self, options: BaseTermOptions) -> None:
        """Replace the options by others of the same functions: what a fit found in the data."""
        self.options = options
        self.strength = getattr(options, "strength", 0.0)

    def description(self) -> dict[str, Any]:
        """Return the options that fix the functions."""
        return self.options.structure()

    def roughness(self) -> Tensor:
        """Return the rows F (R, K) whose squared product with the coefficients is penalised.

        No rows: the term needs no penalty.
        """
        return torch.zeros(0, len(self.symbols), dtype=torch.float64)

    def paper_coefficients(self) -> tuple[dict[str, float], float]:
        """Return the coefficients on unscaled variables, and the constant that remains, metres.

        A term that has no form in the paper gives its coefficients as they are, in metres.
        """
        values = self.coefficients.detach().double().tolist()
        return dict(zip(self.symbols, values, strict=True)), 0.0

    def paper_units(self) -> dict[str, str]:
        """Return the unit of every symbol that `paper_coefficients` may give."""
        return dict.fromkeys(self.symbols, "m")

    def set_paper_coefficients(self, values: dict[str, float]) -> float:
        """Set coefficients on unscaled variables; return the constant they add, metres."""
        own = [values[symbol] for symbol in self.symbols]
        self.coefficients.data.copy_(self.coefficients.new_tensor(own))
        return 0.0


class SignalTerm(Term):
    r"""A function of the distance and the amplitude that a pixel measures.

    .. math:: E(v) = \sum_k \beta_k f_k(D_v, I_v)

    Attributes:
        needs_amplitude: Whether the functions read the amplitude.
        uses_normalised_amplitude: Whether they read it as N = I D^2 alone; beyond the calibrated
            range of N the value at its edge is used.
    """

    needs_amplitude: bool
    uses_normalised_amplitude: bool

    def __init__(self, options: BaseTermOptions, group: str, symbols: list[str]) -> None:
        super().__init__(options, group, symbols)
        self.needs_amplitude = options.needs_amplitude
        self.uses_normalised_amplitude = False

    @abstractmethod
    def basis(self, radial_distance: Tensor, amplitude: Tensor) -> Tensor:
        """Return the functions f_k, shape (K, ...), of distances (...) in metres and amplitudes."""

    @abstractmethod
    def forward(self, radial_distance: Tensor, amplitude: Tensor) -> Tensor:
        """Return the predicted error, shape (...), metres."""

    def polynomial(self) -> ScaledPolynomial | None:
        """Return the term as a polynomial of one variable, which the runtime adds to others.

        None: the runtime evaluates `forward`.
        """
        return None

    def axes(self) -> tuple[Axis, ...] | None:
        """Return the variables of which the term is a function, with the knots of its pieces.

        None: a smooth function of the distance, and of the amplitude if the term needs it.
        """
        return None


class CurveTerm(SignalTerm):
    """A function of one variable of the signal, scaled to [-1, 1] over its calibrated range.

    Args:
        options: The options of the term's kind.
        symbols: The names of the coefficients.
        variable: What it is a function of.
        domain: The calibrated ranges.

    Raises:
        CalibrationDataError: The domain does not know the variable.

    Attributes:
        variable: What it is a function of.
        centre, half_width: Of the variable's range, shape ().
        floor: The amplitude below which the logarithm is constant, shape ().
    """

    centre: Tensor
    half_width: Tensor
    floor: Tensor
    variable: str  # TorchScript knows no literals.

    def __init__(
        self, options: BaseTermOptions, symbols: list[str], variable: Variable, domain: Domain
    ) -> None:
        of_distance = variable == "distance"
        super().__init__(options, "distance" if of_distance else "intensity", symbols)
        self.variable = variable
        self.uses_normalised_amplitude = variable == "normalised_amplitude"
        interval = domain.interval(variable)
        self.register_number("centre", interval.centre)
        self.register_number("half_width", interval.half_width)
        floor = 0.0 if of_distance else domain.amplitude_floor()
        self.register_number("floor", floor, persistent=not of_distance)

    def scaled(self, radial_distance: Tensor, amplitude: Tensor) -> Tensor:
        """Return the scaled variable u, shape (...)."""
        value = radial_distance
        if self.variable == "amplitude":
            value = amplitude
        elif self.variable == "normalised_amplitude":
            value = amplitude * radial_distance * radial_distance
        elif self.variable == "log_amplitude":
            value = torch.maximum(amplitude, self.floor).log()
        return (value - self.centre) / self.half_width

    def scale(self) -> tuple[float, float]:
        """Return centre and half-width."""
        return float(self.centre), float(self.half_width)

    def axis(self, segments: int) -> Axis:
        """Return the variable with so many pieces over its calibrated range."""
        centre, half_width = self.scale()
        low, high = centre - half_width, centre + half_width
        return Axis(self.variable, low, high, segments)  # type: ignore[arg-type]


class PixelTerm(Term):
    r"""A function of the pixel's position in the image.

    .. math:: E(v) = \sum_k \beta_k s_k(r_v, c_v)
    """

    def __init__(self, options: BaseTermOptions, symbols: list[str]) -> None:
        super().__init__(options, "pixel", symbols)

    @abstractmethod
    def basis(self, rows: Tensor, columns: Tensor) -> Tensor:
        """Return the functions s_k, shape (K, ...), of rows and columns (...) in pixels."""

    @abstractmethod
    def forward(self, rows: Tensor, columns: Tensor) -> Tensor:
        """Return the predicted error, shape (...), metres."""


class ConditionTerm(Term):
    r"""A function of one condition of a frame, the same for all of its pixels.

    .. math:: E(v) = \sum_k \beta_k h_k(\text{conditions})

    Every function is zero at the mean conditions of the calibration, so that a frame of unknown
    conditions is corrected as one of mean conditions.

    Args:
        options: The options of the term's kind.
        symbols: The names of the coefficients.
        condition: Which of `CONDITIONS` the functions read.
        domain: The calibrated ranges.

    Raises:
        CalibrationDataError: The condition is not known of every frame.

    Attributes:
        low, high, mean: The condition's range and mean in the calibration, shape ().
    """

    low: Tensor
    high: Tensor
    mean: Tensor

    def __init__(
        self, options: BaseTermOptions, symbols: list[str], condition: str, domain: Domain
    ) -> None:
        super().__init__(options, "condition", symbols)
        self.index: int = CONDITIONS.index(condition)
        if condition not in domain.conditions:
            raise CalibrationDataError(
                f"The model has a term of the {condition.replace('_', ' ')}, which is not known of "
                "every frame: add the column to frames.csv, or choose a model without that term."
            )
        for name, number in zip(("low", "high", "mean"), domain.conditions[condition], strict=True):
            self.register_number(name, number)

    def value(self, conditions: Tensor) -> Tensor:
        """Return the condition, clamped to its calibrated range, shape (...)."""
        return conditions[..., self.index].clamp(self.low, self.high)

    def covers(self, conditions: Tensor) -> Tensor:
        """Return where the condition is within its calibrated range, shape (...), bool."""
        return self.value(conditions) == conditions[..., self.index]

    def inside(self, conditions: Tensor) -> bool:
        """Whether the condition of one frame (C,) is within its calibrated range."""
        return bool(self.covers(conditions))

    @abstractmethod
    def basis(self, conditions: Tensor) -> Tensor:
        """Return the functions h_k, shape (K, ...), of conditions (..., C) as in `CONDITIONS`."""

    @abstractmethod
    def forward(self, conditions: Tensor) -> Tensor:
        """Return the predicted error, shape (...), metres."""


class PixelMap(DescribedModule):
    """One value a pixel, estimated from the residuals of the fitted terms.

    Args:
        options: The options of the map's kind.
        domain: The image size.

    Attributes:
        offset: Shape (H, W), metres, float64.
    """

    offset: Tensor

    def __init__(self, options: BaseTermOptions, domain: Domain) -> None:
        super().__init__()
        self.options = options
        size = (domain.height, domain.width)
        self.register_buffer("offset", torch.zeros(size, dtype=torch.float64))

    def set_options(self, options: BaseTermOptions) -> None:
        """Replace the options by others of the same functions: what a fit found in the data."""
        self.options = options

    def description(self) -> dict[str, Any]:
        """Return kind and image size."""
        return self.options.structure() | {"size": list(self.offset.shape)}
