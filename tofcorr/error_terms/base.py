"""What an error term is: coefficients, and the functions they multiply."""

from abc import ABC, abstractmethod

import torch
from torch import Tensor, nn

Strength = float | str
"""Weight of a term's roughness in the loss: a number, or "auto": by cross-validation."""


class Term(nn.Module, ABC):
    """What all terms share: named coefficients (K,) that start at zero.

    Attributes:
        group: Under which heading the coefficients are reported.
        symbols: Their names, unique within a model.
        coefficients: Shape (K,), metres.
        strength: Weight of `roughness` in the loss, or "auto".
    """

    group: str
    symbols: list[str]
    strength: Strength

    def __init__(self, group: str, symbols: list[str], strength: Strength = 0.0) -> None:
        super().__init__()
        self.group = group
        self.symbols = symbols
        self.strength = strength
        self.coefficients = nn.Parameter(torch.zeros(len(symbols), dtype=torch.float64))

    def roughness(self) -> Tensor:
        """Return the rows F (R, K) whose squared product with the coefficients is penalised.

        No rows: the term needs no penalty.
        """
        return torch.zeros(0, len(self.symbols), dtype=torch.float64)

    def paper_coefficients(self) -> tuple[dict[str, float], float]:
        """Return the coefficients on unscaled variables and the constant they leave over.

        A term that has no form in the paper gives its coefficients as they are, in metres.
        """
        values = self.coefficients.detach().double().tolist()
        return dict(zip(self.symbols, values, strict=True)), 0.0

    def set_paper_coefficients(self, values: dict[str, float]) -> float:
        """Take coefficients on unscaled variables; return the constant they add, metres."""
        own = [values[symbol] for symbol in self.symbols]
        self.coefficients.data.copy_(self.coefficients.new_tensor(own))
        return 0.0


class SignalTerm(Term):
    r"""A term of what each frame brings: the distance and the amplitude of a pixel.

    .. math:: E(v) = \sum_k \beta_k f_k(D_v, I_v)

    """

    needs_amplitude: bool

    def __init__(
        self,
        group: str,
        symbols: list[str],
        *,
        needs_amplitude: bool,
        strength: Strength = 0.0,
    ) -> None:
        super().__init__(group, symbols, strength)
        self.needs_amplitude = needs_amplitude

    @abstractmethod
    def basis(self, radial_distance: Tensor, amplitude: Tensor) -> Tensor:
        """Return the functions f_k, shape (K, ...), of distances (...) in metres and amplitudes."""

    @abstractmethod
    def forward(self, radial_distance: Tensor, amplitude: Tensor) -> Tensor:
        """Return the predicted error, shape (...), metres."""


class PixelTerm(Term):
    r"""A term of where the pixel is.

    .. math:: E(v) = \sum_k \beta_k s_k(r_v, c_v)
    """

    def __init__(self, symbols: list[str]) -> None:
        super().__init__("pixel", symbols)

    @abstractmethod
    def basis(self, rows: Tensor, columns: Tensor) -> Tensor:
        """Return the functions s_k, shape (K, ...), of rows and columns (...) in pixels."""

    @abstractmethod
    def forward(self, rows: Tensor, columns: Tensor) -> Tensor:
        """Return the predicted error, shape (...), metres."""


class ConditionTerm(Term):
    r"""A term of the circumstances of a frame, the same for all of its pixels.

    .. math:: E(v) = \sum_k \beta_k h_k(\text{conditions})

    Every function is zero at the mean conditions of the calibration, so that a frame of unknown
    conditions is corrected as one of mean conditions.

    Args:
        symbols: The coefficients' names.
        index: Which of `CONDITIONS` it looks at.
        known: Its lowest, highest and mean value in the calibration.
    """

    def __init__(self, symbols: list[str], index: int, known: tuple[float, float, float]) -> None:
        super().__init__("condition", symbols)
        self.index: int = index
        self.low, self.high, self.mean = known

    def value(self, conditions: Tensor) -> Tensor:
        """Return the condition looked at, held at its calibrated range, shape (...)."""
        return conditions[..., self.index].clamp(self.low, self.high)

    def inside(self, conditions: Tensor) -> bool:
        """Whether the condition of one frame (C,) is within its calibrated range."""
        return bool(self.value(conditions) == conditions[self.index])

    @abstractmethod
    def basis(self, conditions: Tensor) -> Tensor:
        """Return the functions h_k, shape (K, ...), of conditions (..., C) as in `CONDITIONS`."""

    @abstractmethod
    def forward(self, conditions: Tensor) -> Tensor:
        """Return the predicted error, shape (...), metres."""
