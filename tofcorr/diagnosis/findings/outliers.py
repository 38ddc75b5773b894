"""Which pixels the base fit leaves out or weighs down as outliers: how many, how far off, where.

Gap and effects describe the other pixels. A camera whose errors are rare and large, such as flying
pixels at edges, has most of its error in pixels that are left out.
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from tofcorr.diagnosis.findings.outlier_places import place_of
from tofcorr.diagnosis.sums.study import Study
from tofcorr.geometry.ranges import multiples_in_words, range_of_wrapped

# A warning is given from this share of outliers on. Normal noise makes 1 in 16 000 pixels one; 1 %
# of pixels that are off by 0.1 m hold an error of 10 mm RMS. Chosen.
_WORTH_A_WARNING = 0.01
# Rows and columns of the map of outliers. Chosen: as in the map of the bias.
_TILES = (6, 8)
# Shares below this, which would be rounded to 0.0 %, are stated as fewer than 0.1 %. Derived.
_LEAST_STATED = 0.0005


@dataclass(frozen=True, kw_only=True)
class Outliers:
    """Pixels that the fit does not fully use.

    Attributes:
        deleted: Share of the pixels that get no weight.
        reduced: Share of the pixels that get less than full weight.
        size: Root mean square residual of the deleted pixels, metres; 0 if there are none.
        noise: Root mean square noise of all other pixels, metres.
        tiles: Share of deleted and reduced pixels in each tile of the image, shape (6, 8); NaN
            where the tile holds no pixel.
        place: Where they lie: a clause that follows "They lie".
        wrapped_by: The unambiguous range, metres, if most deleted pixels are off by multiples of
            it; None: they are not, or it is unknown.
    """

    deleted: float
    reduced: float
    size: float
    noise: float
    tiles: np.ndarray
    place: str
    wrapped_by: float | None = None

    @property
    def warning(self) -> str:
        """A sentence or three for people; empty if outliers are rare.

        Fewer are worth one too where they hold more of the squared error than the noise does.
        """
        many = self.deleted + self.reduced >= _WORTH_A_WARNING
        if not (many or self.deleted * self.size**2 > self.noise**2):
            return ""
        parts = []
        if self.deleted:
            parts.append(
                f"{_percent(self.deleted)} of the pixels are off by {1e3 * self.size:.0f} mm RMS "
                f"{self._reason}and are left out as outliers"
            )
        if self.reduced:
            whose = "" if self.deleted else " of the pixels"
            parts.append(f"{_percent(self.reduced)}{whose} count less, as outliers")
        return (
            f"{'; '.join(parts)}. They lie {self.place}. "
            "Gap and effects describe the other pixels: mask these, or find out what they show."
        )

    @property
    def _reason(self) -> str:
        if self.wrapped_by is None:
            return ""
        return f"(most by {multiples_in_words(self.wrapped_by)}: they show a target beyond it) "


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %" if share >= _LEAST_STATED else "fewer than 0.1 %"


def outliers_of(study: Study) -> Outliers:
    """Count the pixels that the base fit leaves out or weighs down, and find where they lie."""
    trust = study.fit.trust
    odd = trust < 1
    deleted = trust == 0
    size, wrapped_by = 0.0, None
    if bool(deleted.any()):
        errors = study.fit.residual[deleted]
        size = float(errors.square().mean().sqrt())
        frequency = study.observations.recording.modulation_frequency
        wrapped_by = range_of_wrapped(errors.numpy(), frequency)
    return Outliers(
        deleted=float(deleted.double().mean()),
        reduced=float((odd & ~deleted).double().mean()),
        size=size,
        noise=study.fit.floor,
        tiles=_shares(study, odd),
        place=place_of(study, odd),
        wrapped_by=wrapped_by,
    )


def _shares(study: Study, odd: Tensor) -> np.ndarray:
    camera, pixel = study.observations.recording.camera, study.observations.pixel
    rows, columns = _TILES
    row = pixel // camera.width * rows // camera.height
    tile = row * columns + pixel % camera.width * columns // camera.width
    zeros = torch.zeros(rows * columns, dtype=torch.float64)
    count = zeros.index_add(0, tile, torch.ones_like(odd, dtype=torch.float64))
    return (zeros.index_add(0, tile, odd.double()) / count).reshape(rows, columns).numpy()
