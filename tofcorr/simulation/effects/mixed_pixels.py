"""Pixels whose footprint spans an edge."""

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from tofcorr.options import Options
from tofcorr.simulation.effects.base import (
    AMPLITUDE,
    FREQUENCY,
    CatalogueEffect,
    Coefficient,
    EffectInputs,
    add_delay,
    blur,
    inputs_from_state,
    phase_difference,
)
from tofcorr.simulation.hooks import FrameState

_EDGES = ("edge_square", "edge", "edge_at_one_metre", "astride", "astride_at_one_metre")
# Standard deviation of the neighbourhood in which edges are looked for, pixels. Set by hand.
_EDGE_PX = 0.8
# Slope of the logarithmic amplitude at which a pixel counts half as an edge, 1 / pixel. Set by
# hand, well above the slope that vignetting and tilt cause.
_EDGE_SLOPE = 0.2
# Brightness varies where its squared second differences exceed this many times the variance of its
# noise. Chosen: four standard deviations.
_VARIES = 16.0


class MixedPixelsShape(Options):
    """Widths of the blur by neighbouring pixels."""

    sigma_px: tuple[float, ...] = (0.6, 1.2)


class MixedPixelsEffect(CatalogueEffect, shape=MixedPixelsShape):
    r"""Signals of neighbouring pixels mixed into one, and further errors at edges.

    .. math:: z' = z + \sum_s w_s (G_s * z - z), \quad
              \Delta d = \frac{c}{4 \pi f} \arg (z' \bar z) + k |\nabla \ln A|^2
              + \Big(e + \frac{f}{d}\Big) \frac{|\nabla \ln A|^2}{|\nabla \ln A|^2 + g_0^2}

    with the phasor z = A exp(j phi) and Gaussians G_s of about a pixel's width. A pixel that sees
    dark and bright surfaces measures nearly the distance of the bright one. The other terms are
    the errors at the edges of squares that Abdo and Borgeat (2010) report. They grow with the
    contrast of the edge, or are the same at every edge (a step or a slit in the surface). A slit of
    fixed width in metres fills a share of the pixel that falls with the distance d in metres.

    Source: Abdo and Borgeat 2010 (square edges); Lindner et al. 2010.
    """

    name = "mixed_pixels"
    summary = "errors where bright and dark meet within one pixel"
    remedy = "a checkerboard in focus and out of focus, shifted by parts of a pixel"
    needs = (AMPLITUDE, FREQUENCY)

    @classmethod
    def terms(cls, shape: MixedPixelsShape) -> tuple[Coefficient, ...]:
        """Return the shares of the neighbours, then the coefficients of edges."""
        shares = [Coefficient(f"share_{sigma:g}px", "1", 1.0) for sigma in shape.sigma_px]
        return (*shares, *(Coefficient(name, "m", cls.prior) for name in _EDGES))

    def shift(self, inputs: EffectInputs, coefficients: Tensor) -> Tensor:
        """Return the error of the mixed phase and of the edges, shape (M,), metres."""
        own = mixed = inputs.signal()
        for share, sigma in zip(coefficients, self.shape.sigma_px, strict=False):
            mixed = mixed + share * (inputs.from_signal(blur, sigma) - own)
        phase = phase_difference(mixed, own)
        return inputs.metres_per_radian * phase + _at_edges(inputs, coefficients)

    def on_signal(self, state: FrameState) -> None:
        """Mix the signals of neighbours."""
        mixed = state.signal
        for share, sigma in zip(self.coefficients, self.shape.sigma_px, strict=False):
            if share != 0:
                mixed = mixed + share * (blur(state.signal, sigma) - state.signal)
        state.signal = mixed

    def on_delay(self, state: FrameState) -> None:
        """Add the errors at edges."""
        if bool(self.coefficients[-len(_EDGES) :].any()):
            add_delay(state, _at_edges(inputs_from_state(state), self.coefficients))


def _at_edges(inputs: EffectInputs, coefficients: Tensor) -> Tensor:
    """Return the errors at edges, shape (M,), metres."""
    edges = inputs.from_images(_edges_of).to(inputs.radial_distance.dtype)
    if inputs.amplitude_noise is not None:
        edges = edges * _brightness_varies(inputs, inputs.amplitude_noise)[:, None]
    contrast, present, shared = edges.unbind(-1)
    square, edge, edge_near, astride, astride_near = coefficients[-len(_EDGES) :].unbind(0)
    near = (edge_near * present + astride_near * shared) / inputs.radial_distance
    return square * contrast + edge * present + astride * shared + near


def _brightness_varies(inputs: EffectInputs, noise: Tensor) -> Tensor:
    r"""Return where brightness varies by more than noise that neighbours share, (M,), bool.

    A camera that filters its images leaves pixels i and j a share r of their noise. The noise of
    their phasors is circular, so that the amplitude of one varies with the phase of the other:
    :math:`E\, \delta A_j \delta\phi_i = r \sigma_A^2 \sin(\phi_j - \phi_i) / A_i`. What depends on
    slopes of the measured amplitude would thus explain noise of the distance. Second differences
    decide, as they do not see the slopes of light and shade.
    """
    return inputs.from_images(_bent_square) > _VARIES * noise**2


def _bent_square(amplitude: Tensor, _distance: Tensor) -> Tensor:
    """Return the mean square of second differences along rows and columns, blurred, (B, H, W)."""
    images = amplitude.double()
    square = torch.zeros_like(images)
    for axis in (1, 2):
        if images.shape[axis] > 2:
            second = images.diff(n=2, dim=axis).square() / 2
            square.narrow(axis, 1, second.shape[axis]).add_(second)
    return blur(square, _EDGE_PX)


def _edges_of(amplitude: Tensor, _distance: Tensor) -> Tensor:
    """Return the functions of edges of amplitude images, shape (B, H, W, 3).

    They are: squared slope of the smoothed logarithm; presence of an edge, from 0 to 1; how evenly
    the pixel is shared between the dark and the bright side, from 0 to 1.
    """
    least = torch.finfo(amplitude.dtype).tiny
    floor = (0.02 * amplitude.amax(dim=(1, 2), keepdim=True)).clamp(min=least)
    bounded = torch.maximum(amplitude, floor)
    logarithm = bounded.log()
    contrast = _squared_slope(blur(logarithm, _EDGE_PX))
    sharp = _squared_slope(logarithm)
    present = sharp / (sharp + _EDGE_SLOPE**2)
    # The extremes of 3 x 3 pixels.
    high, low = (sign * max_pool2d(sign * bounded[:, None], 3, 1, 1)[:, 0] for sign in (1, -1))
    bright = (bounded - low) / (high - low).clamp(min=least)
    jump = (high / low).log() ** 2
    shared = 4 * bright * (1 - bright) * jump / (jump + 4 * _EDGE_SLOPE**2)
    return torch.stack([contrast, present, shared]).movedim(0, -1)


def _squared_slope(images: Tensor) -> Tensor:
    by_row, by_column = torch.gradient(images, dim=(1, 2))
    return by_row.square() + by_column.square()
