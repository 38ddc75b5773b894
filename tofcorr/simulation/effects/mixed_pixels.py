"""Pixels whose footprint spans an edge."""

from typing import ClassVar

import torch
from torch import Tensor

from tofcorr.options import Options
from tofcorr.simulation.effects.base import AMPLITUDE, FREQUENCY, CatalogueEffect, Coefficient
from tofcorr.simulation.effects.inputs import EffectInputs, blur, inputs_from_state
from tofcorr.simulation.hooks import FrameState


class MixedPixelsShape(Options):
    """How wide a pixel's footprint is, beyond the pixel itself."""

    sigma_px: tuple[float, ...] = (0.6, 1.2)


class MixedPixels(CatalogueEffect):
    r"""Signals of neighbouring pixels mixed into one, and what an edge adds.

    .. math:: z' = z + \sum_s w_s (G_s * z - z), \quad
              \Delta d = \frac{c}{4 \pi f} \arg (z' \bar z) + k |\nabla \ln A|^2

    with the phasor z = A exp(j phi) and Gaussians G_s of a pixel's width: a pixel that sees a
    dark and a bright part takes the distance of the bright one. The last term stands for the
    errors at square edges that Abdo and Borgeat (2010) report.
    """

    name = "mixed_pixels"
    summary = "errors where bright and dark meet within one pixel"
    source = "Abdo and Borgeat 2010 (square edges); Lindner et al. 2010"
    remedy = "a checkerboard in focus and out of focus, shifted by parts of a pixel"
    needs = (AMPLITUDE, FREQUENCY)
    shape_type: ClassVar[type[Options]] = MixedPixelsShape

    @classmethod
    def terms(cls, shape: MixedPixelsShape) -> tuple[Coefficient, ...]:
        """Return the shares of the neighbours, then the coefficient at edges."""
        shares = [Coefficient(f"share_{sigma:g}px", "1", 1.0) for sigma in shape.sigma_px]
        return (*shares, Coefficient("edge_square", "m", 0.02))

    def shift(self, inputs: EffectInputs, coefficients: Tensor) -> Tensor:
        """Return the error of the mixed phase and of the edges, shape (M,), metres."""
        shape = self.shape
        own = inputs.signal()
        mixed = own
        for share, sigma in zip(coefficients, shape.sigma_px, strict=False):
            mixed = mixed + share * (inputs.blurred_signal(sigma) - own)
        phase = (mixed * own.conj()).angle()
        return inputs.metres_per_radian * phase + self._edges(inputs) * coefficients[-1]

    def on_signal(self, state: FrameState) -> None:
        """Mix the signals of neighbours."""
        shape = self.shape
        mixed = state.signal
        for share, sigma in zip(self.coefficients, shape.sigma_px, strict=False):
            if share != 0:
                mixed = mixed + share * (blur(state.signal, sigma) - state.signal)
        state.signal = mixed

    def on_delay(self, state: FrameState) -> None:
        """Add what an edge brings."""
        if self.coefficients[-1] != 0:
            shift = self._edges(inputs_from_state(state)) * self.coefficients[-1]
            state.delay = state.delay + shift.reshape(state.radial_distance.shape)

    @staticmethod
    def _edges(inputs: EffectInputs) -> Tensor:
        """Return the squared gradient of the logarithmic amplitude, shape (M,), 1 / pixel^2."""
        return inputs.from_images("edges of the amplitude", _edges_of).double()


def _edges_of(amplitude: Tensor, _distance: Tensor) -> Tensor:
    floor = 0.02 * amplitude.amax(dim=(1, 2), keepdim=True).clamp(min=1e-12)
    logarithm = torch.maximum(amplitude, floor).log()
    smooth = blur(logarithm, 0.8)
    by_row, by_column = torch.gradient(smooth, dim=(1, 2))
    return by_row**2 + by_column**2
