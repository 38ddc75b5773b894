"""What an error term is: coefficients, and the functions they multiply."""

from abc import ABC, abstractmethod

import torch
from torch import Tensor, nn


class SignalTerm(nn.Module, ABC):
    r"""A term of what each frame brings: the distance and the amplitude of a pixel.

    .. math:: E(v) = \sum_k \beta_k f_k(D_v, I_v)

    A concrete term owns `coefficients` (K,), starting at zero, and names them in `symbols`.
    """

    symbols: list[str]
    group: str
    needs_amplitude: bool

    def __init__(self, group: str, symbols: list[str], *, needs_amplitude: bool) -> None:
        super().__init__()
        self.group = group
        self.symbols = symbols
        self.needs_amplitude = needs_amplitude
        self.coefficients = nn.Parameter(torch.zeros(len(symbols), dtype=torch.float64))

    @abstractmethod
    def basis(self, radial_distance: Tensor, amplitude: Tensor) -> Tensor:
        """Return the functions f_k, shape (K, ...), of distances (...) in metres and amplitudes."""

    @abstractmethod
    def forward(self, radial_distance: Tensor, amplitude: Tensor) -> Tensor:
        """Return the predicted error, shape (...), metres."""

    def paper_coefficients(self) -> tuple[dict[str, float], float]:
        """Return the coefficients on unscaled variables and the constant they leave over."""
        raise NotImplementedError(f"{type(self).__name__} has no form in the paper.")

    def set_paper_coefficients(self, values: dict[str, float]) -> float:
        """Take coefficients on unscaled variables; return the constant they add, metres."""
        raise NotImplementedError(f"{type(self).__name__} has no form in the paper.")


class PixelTerm(nn.Module, ABC):
    r"""A term of where the pixel is.

    .. math:: E(v) = \sum_k \beta_k s_k(r_v, c_v)
    """

    symbols: list[str]
    group: str

    def __init__(self, symbols: list[str]) -> None:
        super().__init__()
        self.group = "pixel"
        self.symbols = symbols
        self.coefficients = nn.Parameter(torch.zeros(len(symbols), dtype=torch.float64))

    @abstractmethod
    def basis(self, rows: Tensor, columns: Tensor) -> Tensor:
        """Return the functions s_k, shape (K, ...), of rows and columns (...) in pixels."""

    @abstractmethod
    def forward(self, rows: Tensor, columns: Tensor) -> Tensor:
        """Return the predicted error, shape (...), metres."""

    def paper_coefficients(self) -> tuple[dict[str, float], float]:
        """Return the coefficients on unscaled variables and the constant they leave over."""
        raise NotImplementedError(f"{type(self).__name__} has no form in the paper.")

    def set_paper_coefficients(self, values: dict[str, float]) -> float:
        """Take coefficients on unscaled variables; return the constant they add, metres."""
        raise NotImplementedError(f"{type(self).__name__} has no form in the paper.")
