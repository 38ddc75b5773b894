"""How uncertain a corrected distance is by noise and by calibration, in float32."""

import copy
from collections.abc import Iterable

import torch
from torch import Tensor, nn

from tofcorr.correction.state import CalibrationState
from tofcorr.error_terms.base import EVERYTHING, Domain
from tofcorr.error_terms.model import ErrorModel


class RuntimeSigma(nn.Module):
    r"""Standard deviations of a corrected distance along its ray.

    .. math:: \sigma_\mathrm{noise}^2 = a + b / I + c / I^2, \quad
        \sigma_\mathrm{calibration}^2 = b_v^T C b_v

    with C the covariance of the coefficients and b_v the functions they multiply at the pixel.
    A residual network and a fixed pattern are taken as exact. What is unknown is NaN.

    Args:
        state: The calibration, with covariance and noise where they are known.
        error: Its error model.
        limits: Ranges of the variables, beyond which the edge's value is given.
    """

    factor: Tensor
    noise: list[float]

    def __init__(self, state: CalibrationState, error: ErrorModel, limits: Domain) -> None:
        super().__init__()
        self.signal_terms = frozen(error.signal_terms)
        self.pixel_terms = frozen(error.pixel_terms)
        self.nearest, self.farthest = limits.radial_distance
        self.weakest, self.strongest = limits.amplitude or EVERYTHING
        self.knows_noise: bool = state.noise is not None
        self.noise = list(state.noise or (0.0, 0.0, 0.0))
        self.knows_calibration: bool = state.covariance is not None
        factor = torch.zeros(1, 1, dtype=torch.float64)
        if state.covariance is not None:
            size = len(error.image_symbols())
            values, vectors = torch.linalg.eigh(state.covariance[:size, :size].detach().cpu())
            factor = (vectors * values.clamp(min=0).sqrt()).T
        self.register_buffer("factor", factor.float().contiguous())

    def forward(
        self, radial_distance: Tensor, amplitude: Tensor, rows: Tensor, columns: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return both standard deviations, shape (..., H, W), metres along the ray.

        Args:
            radial_distance: Measured, shape (..., H, W), metres.
            amplitude: The same shape, the camera's units.
            rows: Shape (H, 1), pixels.
            columns: Shape (1, W), pixels.
        """
        unknown = torch.full_like(radial_distance, float("nan"))
        noise, calibration = unknown, unknown
        seen = torch.isfinite(radial_distance) & (radial_distance > 0)
        if self.knows_noise:
            # As `DistanceNoise` has it; the least amplitude, for zero times infinity would be NaN.
            weakness = 1.0 / amplitude.clamp(min=2.0**-126)
            variance = self.noise[0] + weakness * (self.noise[1] + self.noise[2] * weakness)
            noise = torch.where(seen, variance.sqrt(), unknown)
        if self.knows_calibration:
            spread = self.spread(radial_distance, amplitude, rows, columns)
            calibration = torch.where(seen, spread.square().sum(0).sqrt(), unknown)
        return noise, calibration

    def spread(
        self, radial_distance: Tensor, amplitude: Tensor, rows: Tensor, columns: Tensor
    ) -> Tensor:
        """Return independent errors of the calibration (K, ..., H, W), one standard deviation each.

        The arguments are those of `forward`. The squares add up to that of `calibration`.
        """
        distance = radial_distance.clamp(self.nearest, self.farthest)
        strength = amplitude.clamp(self.weakest, self.strongest)
        ones = torch.ones_like(distance)
        functions = [ones.unsqueeze(0)]
        for term in self.signal_terms:
            basis = term.basis(distance, strength)  # pyright: ignore[reportCallIssue]
            functions.append(basis)
        for place in self.pixel_terms:
            u, v = torch.broadcast_tensors(rows, columns)
            found = place.basis(u, v)  # pyright: ignore[reportCallIssue]
            shape = [found.shape[0]] + list(distance.shape)  # noqa: RUF005
            if distance.dim() == 3:
                found = found.unsqueeze(1)
            functions.append(found.expand(shape))
        return torch.tensordot(self.factor, torch.cat(functions), dims=1)


def frozen(terms: Iterable[nn.Module], dtype: torch.dtype = torch.float32) -> nn.ModuleList:
    """Return copies of terms, of this type, that are not trained."""
    copied = nn.ModuleList([copy.deepcopy(term) for term in terms])
    return copied.to(dtype).requires_grad_(requires_grad=False)
