"""What an error term is: coefficients, and the functions they multiply."""

from abc import ABC, abstractmethod
from typing import Any

import torch
from torch import Tensor, nn

from tofcorr.conditions import CONDITIONS
from tofcorr.error_terms.axis import Axis
from tofcorr.error_terms.described import DescribedModule
from tofcorr.error_terms.domain import Domain
from tofcorr.error_terms.polynomial import ScaledPolynomial
from tofcorr.error_terms.term_options import BaseTermOptions
from tofcorr.errors import CalibrationDataError

Strength = float | str
"""Weight of a term's roughness in the loss: a number, or "auto": by cross-validation."""


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
