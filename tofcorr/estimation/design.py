r"""The columns of the residual, factored into functions of the frame and of the pixel.

Every column of the error model is a signal function f(D, I) times a pixel function s(r, c), one
of them 1. With the viewing ray (x, y, z) the residual of a pixel is a combination of

.. math:: \{x, y, z\} \times \{D, f_k s_k\}, \; 1

and its moments are sums of products of such pairs. Products of signal functions change from
frame to frame; products of pixel functions and rays do not, and are computed once.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from tofcorr.error_terms.base import SignalTerm
from tofcorr.error_terms.domain import Domain
from tofcorr.error_terms.model import ErrorModel

# Random points at which products of functions are compared. Products whose randomly weighted sums
# over them agree to ten digits count as one function. Splines, which are zero on most points, need
# many. A wrong match could only merge products that differ by less than the rounding of their sums.
# Set by hand.
_PROBES = 2048


@dataclass(frozen=True)
class PairTable:
    """Distinct products of functions, and where the product of two functions is found.

    Attributes:
        left: First factor of each distinct product, shape (P,).
        right: Second factor of each distinct product, shape (P,).
        index: Which distinct product f_a f_b is, shape (F, F).
    """

    left: Int[Tensor, "P"]
    right: Int[Tensor, "P"]
    index: Int[Tensor, "F F"]

    @staticmethod
    def of(values: Float[Tensor, "F probes"]) -> "PairTable":
        """Find the distinct products of functions from their values (F, probes)."""
        left, right = torch.triu_indices(len(values), len(values)).unbind(0)
        random = torch.rand(values.shape[1], 2, generator=_generator(), dtype=values.dtype)
        fingerprints = ((values[left] * values[right]) @ random).tolist()
        distinct: dict[tuple[str, ...], int] = {}
        found = [
            distinct.setdefault(tuple(f"{number:.9e}" for number in fingerprint), len(distinct))
            for fingerprint in fingerprints
        ]
        index = torch.empty(len(values), len(values), dtype=torch.long)
        index[left, right] = index[right, left] = torch.tensor(found)
        first = torch.tensor([found.index(k) for k in range(len(distinct))])
        return PairTable(left[first], right[first], index)


class Design:
    """The columns of one error model (or of the union of several) on one camera.

    Column 0 is the measured distance; the others follow `ErrorModel.coefficient_vector`: the
    constant, the signal terms, the pixel terms. Condition terms need no column of pixels: theirs is
    the constant's times a number a frame, see `ImageMoments.with_conditions`. `signal[k]` and
    `pixel[k]` say which signal function and which pixel function make up column k; function 0 is 1
    in both lists, and signal function 1 is the measured distance.

    Args:
        model: The error model; only its basis functions matter, not its coefficients.
        domain: The ranges that the model is scaled to.
        ray_directions: Unit viewing rays, shape (H, W, 3), float64.
    """

    def __init__(
        self, model: ErrorModel, domain: Domain, ray_directions: Float[Tensor, "H W 3"]
    ) -> None:
        self.signal_terms: list[SignalTerm] = list(model.signal_terms)  # type: ignore[arg-type]
        self.symbols = model.image_symbols()
        self.ray_directions = ray_directions
        self.needs_amplitude = model.needs_amplitude()
        self.pixel_functions = _pixel_functions(model, ray_directions)
        num_signal = sum(term.coefficients.numel() for term in self.signal_terms)
        num_pixel = len(self.pixel_functions) - 1
        self.signal = torch.tensor([1, 0, *range(2, 2 + num_signal), *[0] * num_pixel])
        self.pixel = torch.tensor([0, 0, *[0] * num_signal, *range(1, 1 + num_pixel)])
        probes = _probes(domain)
        self.signal_pairs = PairTable.of(self.signal_functions(*probes))
        self.distance_as = self._affine(*probes)
        some = torch.linspace(0, self.pixel_functions[0].numel() - 1, _PROBES).long()
        self.pixel_pairs = PairTable.of(self.pixel_functions.flatten(1)[:, some])

    @property
    def num_columns(self) -> int:
        """Columns without the ray: the distance and the coefficients."""
        return len(self.signal)

    def signal_functions(
        self, radial_distance: Float[Tensor, "*pixels"], amplitude: Float[Tensor, "*pixels"]
    ) -> Float[Tensor, "F *pixels"]:
        """Return 1, D and the signal terms' basis, shape (F, ...)."""
        with torch.no_grad():
            bases = [term.basis(radial_distance, amplitude) for term in self.signal_terms]
            ones = torch.ones_like(radial_distance)[None]
            return torch.cat([ones, radial_distance[None], *bases])

    def _affine(
        self, distance: Float[Tensor, "probes"], amplitude: Float[Tensor, "probes"]
    ) -> tuple[int, float, float] | None:
        """Return a signal function u and numbers c, h so that c + h u is the distance; or None."""
        number = 2
        for term in self.signal_terms:
            form = term.polynomial()
            if form is not None and form.variable == "distance":
                u = term.basis(distance, amplitude)[0].detach()
                if torch.allclose(form.centre + form.half_width * u, distance, rtol=1e-14):
                    return number, float(form.centre), float(form.half_width)
            number += len(term.symbols)
        return None


def _pixel_functions(
    model: ErrorModel, ray_directions: Float[Tensor, "H W 3"]
) -> Float[Tensor, "F H W"]:
    height, width = ray_directions.shape[:2]
    rows = torch.arange(height).to(ray_directions)[:, None].expand(height, width)
    columns = torch.arange(width).to(ray_directions).expand(height, width)
    with torch.no_grad():
        bases = [term.basis(rows, columns) for term in model.pixel_terms]  # type: ignore[operator]
    return torch.cat([torch.ones_like(rows)[None], *bases])


def _probes(domain: Domain) -> tuple[Float[Tensor, "probes"], Float[Tensor, "probes"]]:
    """Return random distances and amplitudes of the domain, always the same ones."""
    random = torch.rand(2, _PROBES, generator=_generator(), dtype=torch.float64)
    low, high = domain.radial_distance
    distance = low + (high - low) * random[0]
    if domain.amplitude is None:
        return distance, torch.ones_like(distance)
    low, high = domain.amplitude
    return distance, low + (high - low) * random[1]


def _generator() -> torch.Generator:
    """Return the generator of the random points; no result depends on it, so it is no argument."""
    return torch.Generator().manual_seed(0)
