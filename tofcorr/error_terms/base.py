"""What an error term is: options, coefficients, ranges, and the functions it is made of.

Powers leave out the constant, which an error model has already. So do B-splines, which sum to one:
the function in the middle is omitted. They are uniform, of degree 1 and 3 on [-1, 1], and keep
their value at the edge beyond it. All functions but those of lists compile with TorchScript.
"""

import json
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from math import inf, log
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

import numpy as np
import torch
from pydantic import AfterValidator, ConfigDict
from torch import Tensor, nn

from tofcorr.conditions import CONDITIONS
from tofcorr.errors import CalibrationDataError, StateError
from tofcorr.options import FiniteNumber, Options, PositiveNumber, Size, among

# Random points at which functions are compared. Splines, which are zero on most, need many. Set by
# hand.
_PROBES = 2048

Variable = Literal["distance", "amplitude", "normalised_amplitude", "log_amplitude"]
"""What a signal term is a function of; the normalised amplitude is N = I D^2."""
LOG_FLOOR = 1e-4
"""Amplitudes below this share of the calibrated maximum (no unit) enter the logarithm as this
share: the logarithm of a dead pixel carries no information. Set by hand; four decades are more than
any camera resolves."""


class Interval(NamedTuple):
    """A closed interval of one variable."""

    low: FiniteNumber
    high: FiniteNumber

    @property
    def centre(self) -> float:
        """The midpoint."""
        return (self.low + self.high) / 2

    @property
    def half_width(self) -> float:
        """Half the length; 1 for an interval of no length, so that scaling by it stays defined."""
        return (self.high - self.low) / 2 or 1.0

    def scale(self, values: Tensor) -> Tensor:
        """Map the interval onto [-1, 1]."""
        return (values - self.centre) / self.half_width

    def outwards(self) -> "Interval":
        """Return the smallest interval between float32 numbers that holds this one."""
        low, high = np.float32(self.low), np.float32(self.high)
        outside = np.nextafter(low, np.float32(-inf)), np.nextafter(high, np.float32(inf))
        low = outside[0] if low > self.low else low
        return Interval(float(low), float(outside[1] if high < self.high else high))


EVERYTHING = Interval(-inf, inf)
"""No limits."""


def _ordered(ends: Interval) -> Interval:
    if ends[0] > ends[1]:
        raise ValueError("the first end of a range is the lower one")
    return ends


_Range = Annotated[Interval, AfterValidator(_ordered)]
_Three = tuple[FiniteNumber, FiniteNumber, FiniteNumber]
_Conditions = Mapping[Annotated[str, among(CONDITIONS, "condition")], _Three]


@dataclass(frozen=True, kw_only=True)
class Domain:
    """Where a model holds: image size, distances and amplitudes seen in calibration.

    Attributes:
        height: Rows of the image.
        width: Columns of the image.
        radial_distance: Range of measured distances along the ray, metres.
        amplitude: Range of amplitudes in the camera's units; None without amplitudes.
        normalised_amplitude: Range of N = I D^2; None without amplitudes.
        modulation_frequency: Of the light, Hz; None if unknown.
        conditions: Lowest, highest and mean value of each of `CONDITIONS` that is known of all
            frames.
    """

    __pydantic_config__ = ConfigDict(extra="forbid")  # For the files that hold one.

    height: Size
    width: Size
    radial_distance: _Range
    amplitude: _Range | None = None
    normalised_amplitude: _Range | None = None
    modulation_frequency: PositiveNumber | None = None
    conditions: _Conditions = field(default_factory=dict)

    def mean_conditions(self) -> list[float]:
        """Return the mean conditions in the order of `CONDITIONS`; 0 where unknown."""
        return [self.conditions.get(name, (0.0, 0.0, 0.0))[2] for name in CONDITIONS]

    def holds(self, distance: Tensor, amplitude: Tensor | None) -> Tensor:
        """Return where distance and amplitude are in their ranges, shape of the distance, bool."""
        low, high = self.radial_distance
        inside = (distance >= low) & (distance <= high)
        if self.amplitude is not None and amplitude is not None:
            low, high = self.amplitude
            inside &= (amplitude >= low) & (amplitude <= high)
        return inside

    def joined(self, other: "Domain") -> "Domain":
        """Return the smallest ranges that hold these and another domain's, of the same image size.

        The mean of a condition is the middle of both. What one of them does not know is unknown.

        Raises:
            CalibrationDataError: The images or the modulation frequencies differ.
        """
        for name in ("height", "width", "modulation_frequency"):
            own, its = getattr(self, name), getattr(other, name)
            if own != its:
                raise CalibrationDataError(f"One camera's {name} cannot be both {own} and {its}.")
        ranges = {
            name: Interval(min(own.low, its.low), max(own.high, its.high))
            for name in ("radial_distance", "amplitude", "normalised_amplitude")
            if (own := getattr(self, name)) and (its := getattr(other, name))
        }
        both = {
            name: (min(own[0], its[0]), max(own[1], its[1]), (own[2] + its[2]) / 2)
            for name, own in self.conditions.items()
            if (its := other.conditions.get(name))
        }
        nothing = dict.fromkeys(("amplitude", "normalised_amplitude"))
        return replace(self, **{**nothing, **ranges}, conditions=both)

    def probes(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return distances (M,), amplitudes (M,) and conditions (M, C) of the ranges, float64.

        They are random and always the same ones. Amplitudes are 1 and conditions 0 where unknown.
        """
        known = [self.conditions.get(name, (0.0, 0.0, 0.0))[:2] for name in CONDITIONS]
        ends = torch.tensor([self.radial_distance, self.amplitude or (1.0, 1.0), *known])
        generator = torch.Generator().manual_seed(0)  # No result depends on the random points.
        random = torch.rand(len(ends), _PROBES, generator=generator, dtype=torch.float64)
        low, high = ends.double().T[:, :, None]
        distance, amplitude, *conditions = low + (high - low) * random
        return distance, amplitude, torch.stack(conditions, dim=1)

    def amplitude_floor(self) -> float:
        """Return the amplitude below which the logarithm is constant.

        Raises:
            CalibrationDataError: No amplitudes are known.
        """
        if self.amplitude is None or self.normalised_amplitude is None:
            raise CalibrationDataError("An intensity term needs amplitude.npy; or choose others.")
        return max(self.amplitude.high * LOG_FLOOR, float(np.finfo(np.float32).tiny))

    def interval(self, variable: Variable) -> Interval:
        """Return the calibrated range of a variable.

        Raises:
            CalibrationDataError: It is an amplitude, and no amplitudes are known.
        """
        if variable == "distance":
            return self.radial_distance
        floor = self.amplitude_floor()
        known = getattr(self, variable.removeprefix("log_"))
        if variable == "log_amplitude":
            return Interval(*(log(max(end, floor)) for end in known))
        return known


class ScaledPolynomial(NamedTuple):
    """The polynomial sum_k c_k u^k, k = 1..K, in u = (x - centre) / half_width.

    Attributes:
        variable: What x is.
        coefficients: c_1 .. c_K, shape (K,), metres.
        centre: In units of x.
        half_width: In units of x.
    """

    variable: Variable
    coefficients: Tensor
    centre: float
    half_width: float


class Axis(NamedTuple):
    """Equally spaced knots of one variable; between them a term is smooth.

    Attributes:
        variable: What x is.
        low: First knot, in units of x; below it the term keeps its value there.
        high: Last knot; beyond it the term keeps its value there.
        segments: Number of pieces.
    """

    variable: Variable
    low: float
    high: float
    segments: int = 1


def powers(scaled: Tensor, degree: int) -> Tensor:
    """Return u, u^2, ..., u^degree, shape (degree, ...)."""
    columns = [scaled]
    for _ in range(degree - 1):
        columns.append(columns[-1] * scaled)
    return torch.stack(columns)


def combined(coefficients: Tensor, functions: Tensor) -> Tensor:
    """Return the sum of functions (K, ...), each times its coefficient, in full precision."""
    return (functions.movedim(0, -1) * coefficients).sum(-1)


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
        has_columns: Whether the term is linear in a few coefficients, which the moments estimate.
    """

    kind: Any  # A literal in every kind.
    has_columns: ClassVar[bool] = True


class DescribedModule(nn.Module):
    """A module that stores a description of itself in its `state_dict`.

    All that the output depends on is a parameter, a buffer, or part of the description. Parameters
    and buffers are loaded; the description must be equal.
    """

    def description(self) -> dict[str, Any]:
        """Return what a state must agree on to be loaded, as plain values: the fixed options."""
        return self.options.structure()  # type: ignore[union-attr, operator]

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
        own, stored = self.description(), self._description_in(state)
        for key in dict.fromkeys([*own, *stored]):
            expected, found = own.get(key), stored.get(key)
            if found != json.loads(json.dumps(expected)):
                said = f"the state is of another model: its '{key}' is {found}, not {expected}"
                raise StateError(f"{type(self).__name__}: {said}. Build it alike.")

    def register_interval(self, prefix: str, interval: Interval) -> None:
        """Keep `centre` and `half_width` of an interval, each behind a prefix, as such numbers."""
        self.register_number(f"{prefix}centre", interval.centre)
        self.register_number(f"{prefix}half_width", interval.half_width)

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
    """

    def __init__(self, options: BaseTermOptions, group: str, symbols: list[str]) -> None:
        super().__init__()
        self.options, self.group, self.symbols = options, group, symbols
        self.coefficients = nn.Parameter(torch.zeros(len(symbols), dtype=torch.float64))

    def roughness(self) -> Tensor:
        """Return the rows F (R, K) whose squared product with the coefficients is penalised.

        No rows: the term needs no penalty. The options of a term with rows hold its `strength`.
        """
        return torch.zeros(0, len(self.symbols), dtype=torch.float64)

    def paper_coefficients(self) -> tuple[dict[str, tuple[float, str]], float]:
        """Return the coefficients on unscaled variables, each with its unit, and what remains.

        A term that has no form in the paper gives its coefficients as they are, in metres. What
        remains is a constant, metres.
        """
        values = self.coefficients.detach().double().tolist()
        return {symbol: (own, "m") for symbol, own in zip(self.symbols, values, strict=True)}, 0.0

    def set_paper_coefficients(self, values: dict[str, float]) -> float:
        """Set coefficients on unscaled variables; return the constant they add, metres."""
        self.set_coefficients([values[symbol] for symbol in self.symbols])
        return 0.0

    def set_coefficients(self, values: list[float]) -> None:
        """Set the coefficients, metres, untouched by autograd."""
        self.coefficients.data.copy_(self.coefficients.new_tensor(values))


class SignalTerm(Term):
    r"""A function of the distance and the amplitude that a pixel measures.

    .. math:: E(v) = \sum_k \beta_k f_k(D_v, I_v)

    Attributes:
        needs_amplitude: Whether the functions read the amplitude.
        uses_normalised_amplitude: Whether they read it as N = I D^2 alone; beyond the calibrated
            range of N the value at its edge is used.
    """

    def __init__(self, options: BaseTermOptions, group: str, symbols: list[str]) -> None:
        super().__init__(options, group, symbols)
        self.needs_amplitude: bool = options.needs_amplitude
        variable = getattr(options, "variable", None)
        self.uses_normalised_amplitude: bool = variable == "normalised_amplitude"

    @abstractmethod
    def basis(self, radial_distance: Tensor, amplitude: Tensor) -> Tensor:
        """Return the functions f_k, shape (K, ...), of distances (...) in metres and amplitudes."""

    def forward(self, radial_distance: Tensor, amplitude: Tensor) -> Tensor:
        """Return the predicted error, shape (...), metres."""
        return combined(self.coefficients, self.basis(radial_distance, amplitude))

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
        self.register_interval("", domain.interval(variable))
        floor = 0.0 if of_distance else domain.amplitude_floor()
        self.register_number("floor", floor, persistent=not of_distance)

    def scaled(self, radial_distance: Tensor, amplitude: Tensor) -> Tensor:
        """Return the scaled variable u, shape (...)."""
        value = variable_of(self.variable, radial_distance, amplitude, self.floor)
        return (value - self.centre) / self.half_width

    def scale(self) -> tuple[float, float]:
        """Return centre and half-width."""
        return float(self.centre), float(self.half_width)


def variable_of(variable: str, radial_distance: Tensor, amplitude: Tensor, floor: Tensor) -> Tensor:
    """Return a variable of the signal, shape (...); the logarithm is constant below the floor."""
    if variable == "distance":
        return radial_distance
    if variable == "normalised_amplitude":
        return amplitude * radial_distance * radial_distance
    return torch.maximum(amplitude, floor).log() if variable == "log_amplitude" else amplitude


def axis_of(variable: str, centre: Tensor, half_width: Tensor, segments: int) -> Axis:
    """Return a variable with so many pieces over its calibrated range."""
    low, high = float(centre - half_width), float(centre + half_width)
    return Axis(variable, low, high, segments)  # type: ignore[arg-type]


class PixelTerm(Term):
    r"""A function of the pixel's position in the image.

    .. math:: E(v) = \sum_k \beta_k s_k(r_v, c_v)
    """

    @abstractmethod
    def basis(self, rows: Tensor, columns: Tensor) -> Tensor:
        """Return the functions s_k, shape (K, ...), of rows and columns (...) in pixels."""

    def forward(self, rows: Tensor, columns: Tensor) -> Tensor:
        """Return the predicted error, shape (...), metres."""
        return combined(self.coefficients, self.basis(rows, columns))


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
            name = condition.replace("_", " ")
            raise CalibrationDataError(f"A term needs every frame's {name}: add it to frames.csv.")
        for name, number in zip(("low", "high", "mean"), domain.conditions[condition], strict=True):
            self.register_number(name, number)

    def value(self, conditions: Tensor) -> Tensor:
        """Return the condition, clamped to its calibrated range, shape (...)."""
        return conditions[..., self.index].clamp(self.low, self.high)

    def covers(self, conditions: Tensor) -> Tensor:
        """Return where the condition is within its calibrated range, shape (...), bool."""
        return self.value(conditions) == conditions[..., self.index]

    @abstractmethod
    def basis(self, conditions: Tensor) -> Tensor:
        """Return the functions h_k, shape (K, ...), of conditions (..., C) as in `CONDITIONS`."""

    def forward(self, conditions: Tensor) -> Tensor:
        """Return the predicted error, shape (...), metres."""
        return combined(self.coefficients, self.basis(conditions))


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

    def description(self) -> dict[str, Any]:
        """Return kind and image size."""
        return self.options.structure() | {"size": list(self.offset.shape)}
