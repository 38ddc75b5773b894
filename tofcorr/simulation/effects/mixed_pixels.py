"""Pixels whose footprint spans an edge."""

from typing import ClassVar

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from tofcorr.options import Options
from tofcorr.simulation.effects.base import CatalogueEffect, Coefficient
from tofcorr.simulation.effects.blur import blur
from tofcorr.simulation.effects.inputs import EffectInputs
from tofcorr.simulation.effects.needs import AMPLITUDE, FREQUENCY
from tofcorr.simulation.effects.state_inputs import inputs_from_state
from tofcorr.simulation.hooks import FrameState

_EDGES = ("edge_square", "edge", "edge_at_one_metre", "astride", "astride_at_one_metre")
# Slope of the logarithmic amplitude that makes an edge, 1 / pixel.
_EDGE_SLOPE = 0.2


class MixedPixelsShape(Options):
    """How wide a pixel's footprint is, beyond the pixel itself."""

    sigma_px: tuple[float, ...] = (0.6, 1.2)


class MixedPixelsEffect(CatalogueEffect):
    r"""Signals of neighbouring pixels mixed into one, and what an edge adds.

    .. math:: z' = z + \sum_s w_s (G_s * z - z), \quad
              \Delta d = \frac{c}{4 \pi f} \arg (z' \bar z) + k |\nabla \ln A|^2
              + \Big(e + \frac{f}{d}\Big) \frac{|\nabla \ln A|^2}{|\nabla \ln A|^2 + g_0^2}

    with the phasor z = A exp(j phi) and Gaussians G_s of a pixel's width: a pixel that sees a
    dark and a bright part takes the distance of the bright one. The other terms stand for the
    errors at square edges that Abdo and Borgeat (2010) report: growing with the edge's contrast, or
    the same at every edge, as steps and slits of the surface are; of a given width in metres
    they take up a share of the pixel that falls with the distance d, in metres.
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
        return (*shares, *(Coefficient(name, "m", 0.02) for name in _EDGES))

    def shift(self, inputs: EffectInputs, coefficients: Tensor) -> Tensor:
        """Return the error of the mixed phase and of the edges, shape (M,), metres."""
        shape = self.shape
        own = inputs.signal()
        mixed = own
        for share, sigma in zip(coefficients, shape.sigma_px, strict=False):
            mixed = mixed + share * (inputs.blurred_signal(sigma) - own)
        phase = (mixed * own.conj()).angle()
        return inputs.metres_per_radian * phase + self._edges(inputs) @ coefficients[-len(_EDGES) :]

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
        if bool((self.coefficients[-len(_EDGES) :] != 0).any()):
            shift = self._edges(inputs_from_state(state)) @ self.coefficients[-len(_EDGES) :]
            state.delay = state.delay + shift.reshape(state.radial_distance.shape)

    @staticmethod
    def _edges(inputs: EffectInputs) -> Tensor:
        """Return what an edge does by its contrast, by being there, and by its share, (M, 3)."""
        contrast, there, astride = (
            inputs.from_images("edges of the amplitude", _edges_of).double().unbind(-1)
        )
        nearness = 1 / inputs.radial_distance
        return torch.stack([contrast, there, there * nearness, astride, astride * nearness], dim=-1)


def _edges_of(amplitude: Tensor, _distance: Tensor) -> Tensor:
    """Return squared slopes of the logarithm over two pixels, and whether there is an edge."""
    floor = 0.02 * amplitude.amax(dim=(1, 2), keepdim=True).clamp(min=1e-12)
    bounded = torch.maximum(amplitude, floor)
    logarithm = bounded.log()
    contrast = _squared_slope(blur(logarithm, 0.8))
    sharp = _squared_slope(logarithm)
    there = sharp / (sharp + _EDGE_SLOPE**2)
    high = max_pool2d(bounded[:, None], 3, 1, 1)[:, 0]
    low = -max_pool2d(-bounded[:, None], 3, 1, 1)[:, 0]
    part = (bounded - low) / (high - low).clamp(min=1e-12)
    jump = (high / low).log() ** 2
    astride = 4 * part * (1 - part) * jump / (jump + 4 * _EDGE_SLOPE**2)
    return torch.stack([contrast, there, astride], dim=-1)


def _squared_slope(images: Tensor) -> Tensor:
    by_row, by_column = torch.gradient(images, dim=(1, 2))
    return by_row**2 + by_column**2
