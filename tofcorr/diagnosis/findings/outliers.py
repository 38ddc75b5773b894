"""Where a set of pixels lies: at edges, in a part of the image, in some frames, at a distance.

Which pixels the base fit leaves out or weighs down as outliers: how many, how far off, where.

Gap and effects describe the other pixels. A camera whose errors are rare and large, such as flying
pixels at edges, has most of its error in pixels that are left out.

Masks that leave little of the images.

A mask that a plane fit made from the depth leaves out the pixels with the largest errors. Of a
strong pattern of the sensor it leaves few pixels, and what is left of it looks like noise.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from tofcorr.diagnosis.sums.observations import Observations
from tofcorr.diagnosis.sums.study import Study
from tofcorr.geometry.ranges import multiples_in_words, range_of_wrapped

# A group of pixels is crowded if its share of chosen ones exceeds that of all pixels this many
# times. Chosen.
_CROWDED = 3.0
# So many chosen pixels of a group are no crowd, however few are expected. Chosen: above ten, chance
# alone does not triple a count.
_BY_CHANCE = 10
# Crowded groups are reported if together they hold this share of the chosen pixels. Chosen.
_MOST_OF_THEM = 0.5
# Tiles along each side of the image, and groups of a covariate with equally many pixels. Chosen.
_TILES, _GROUPS = 8, 8
# Brightest over darkest pixel of a 3 x 3 neighbourhood that holds an edge of the target. Chosen:
# neighbours of one reflectivity differ by a few per cent and by noise.
_EDGE_RATIO = 1.5
# Most frames that are listed. Chosen: a line of text.
_MOST_LISTED = 8


class _Place(NamedTuple):
    """A clause, the share of the chosen pixels that it covers, and the share of all pixels."""

    words: str
    held: float
    of_all: float


def place_of(study: Study, chosen: Tensor) -> str:
    """Return a clause that says where the chosen pixels (M,) lie."""
    count = float(chosen.sum())
    if not count:
        return "nowhere"
    found = [*_edges(study, chosen), *_parts(study, chosen)]
    crowded = [place for place in found if place.held >= _MOST_OF_THEM]
    if not crowded:
        return "all over the images"
    best = max(crowded, key=lambda place: place.held - place.of_all)
    return f"mostly {best.words} ({100 * best.held:.0f} % of them)"


def _edges(study: Study, chosen: Tensor) -> list[_Place]:
    """Return the places beside edges of brightness and of the target's mask, if crowded."""
    observations = study.observations
    places = {
        "at the rim of the target's mask": _at_edges(observations, observations.on_target, 1.0)
    }
    if observations.amplitude_images is not None:
        there = _at_edges(observations, observations.amplitude_images, _EDGE_RATIO)
        places["at edges between dark and bright"] = there
    found = []
    for words, there in places.items():
        if _share(chosen, there) > _CROWDED * float(chosen.double().mean()):
            found.append(_place(words, there, chosen))
    return found


def _at_edges(observations: Observations, images: Tensor, ratio: float) -> Tensor:
    """Return which pixels (M,) lie where images (F, H, W) change by more than a ratio."""
    found = []
    for frame, (start, end) in enumerate(observations.frame_ends):
        near = _near(images[frame].float(), observations.on_target[frame])
        found.append(near.flatten()[observations.pixel[start:end]] > ratio)
    return torch.cat(found)


def _near(image: Tensor, inside: Tensor) -> Tensor:
    """Return the largest over the smallest value in 3 x 3 pixels, (H, W); 1 outside a mask."""
    high = max_pool2d(image[None], 3, 1, 1)[0]
    low = -max_pool2d(-image[None], 3, 1, 1)[0]
    return torch.where(inside, high / low.clamp(min=1e-3 * high), 1.0).nan_to_num(1.0)


def _share(of: Tensor, among: Tensor) -> float:
    return float(of[among].double().mean()) if bool(among.any()) else 0.0


def _parts(study: Study, chosen: Tensor) -> list[_Place]:
    """Return the crowded part of the image, frames, distances and amplitudes."""
    observations = study.observations
    found = [_box(study, chosen), _frames(observations.frame, chosen)]
    values = {"at distances from {:.2f} to {:.2f} m": study.inputs.radial_distance}
    if observations.amplitude is not None:
        values["at amplitudes from {:.0f} to {:.0f}"] = observations.amplitude
    for words, covariate in values.items():
        there = _crowded(_ranked(covariate), chosen)
        if bool(there.any()):
            low, high = float(covariate[there].min()), float(covariate[there].max())
            found.append(_place(words.format(low, high), there, chosen))
    return [place for place in found if place is not None]


def _box(study: Study, chosen: Tensor) -> _Place | None:
    """Return the box around the crowded tiles of the image."""
    camera, pixel = study.observations.recording.camera, study.observations.pixel
    row, column = pixel // camera.width, pixel % camera.width
    tile = row * _TILES // camera.height * _TILES + column * _TILES // camera.width
    members = chosen & _crowded(tile, chosen)
    if not bool(members.any()):
        return None
    (top, bottom), (left, right) = _ends(row[members]), _ends(column[members])
    inside = (row >= top) & (row <= bottom) & (column >= left) & (column <= right)
    if _share(chosen, inside) <= _CROWDED * float(chosen.double().mean()):
        return None
    return _place(f"in rows {top} to {bottom} and columns {left} to {right}", inside, chosen)


def _ends(values: Tensor) -> tuple[int, int]:
    return int(values.min()), int(values.max())


def _frames(frame: Tensor, chosen: Tensor) -> _Place | None:
    there = _crowded(frame, chosen)
    if not bool(there.any()):
        return None
    numbers = frame[there].unique().tolist()
    words = f"in frame{'s' * (len(numbers) > 1)} {', '.join(map(str, numbers[:_MOST_LISTED]))}"
    if len(numbers) > _MOST_LISTED:
        words += f" and {len(numbers) - _MOST_LISTED} more"
    return _place(words, there, chosen)


def _place(words: str, there: Tensor, chosen: Tensor) -> _Place:
    return _Place(words, _share(there, chosen), float(there.double().mean()))


def _ranked(values: Tensor) -> Tensor:
    """Return groups of equally many pixels, by value, shape (M,)."""
    inner = torch.linspace(0, 1, _GROUPS + 1, dtype=torch.float64)[1:-1]
    return torch.bucketize(values, torch.quantile(values[:: len(values) // 100_000 + 1], inner))


def _crowded(group: Tensor, chosen: Tensor) -> Tensor:
    """Return which pixels lie in groups with many chosen ones, shape (M,)."""
    expected = torch.bincount(group) * chosen.double().mean()
    return (torch.bincount(group, chosen.double()) > _CROWDED * expected + _BY_CHANCE)[group]


# A warning is given from this share of outliers on. Normal noise makes 1 in 16 000 pixels one; 1 %
# of pixels that are off by 0.1 m hold an error of 10 mm RMS. Chosen.
_WORTH_A_WARNING = 0.01
# Rows and columns of the map of outliers. Chosen: as in the map of the bias.
_MAP_TILES = (6, 8)
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
    rows, columns = _MAP_TILES
    row = pixel // camera.width * rows // camera.height
    tile = row * columns + pixel % camera.width * columns // camera.width
    zeros = torch.zeros(rows * columns, dtype=torch.float64)
    count = zeros.index_add(0, tile, torch.ones_like(odd, dtype=torch.float64))
    return (zeros.index_add(0, tile, odd.double()) / count).reshape(rows, columns).numpy()


# Other poses that show a pixel on the target, on average, below which a warning is given. Derived:
# what two poses agree in is a pattern; one pose has nothing to agree with.
_LEAST_OTHERS = 1.0
# Share of the measured pixels that a mask leaves below which one is given too. Chosen: a board that
# fills a seventh of the image in width and height.
_LEAST_SHARE = 0.02


def mask_warning(observations: Observations) -> str:
    """Return a sentence or two for people; empty without a mask, or if it leaves enough."""
    if observations.recording.mask is None:
        return ""
    seen, measured = observations.usable, observations.distance_images > 0
    share = float(seen.sum() / measured.sum().clamp(min=1))
    poses = torch.zeros(seen.shape[1:], dtype=torch.float64)
    for unit in range(observations.num_units):
        poses += seen[observations.unit == unit].any(0)
    alone = float((poses * (poses - 1)).sum() / poses.sum().clamp(min=1)) < _LEAST_OTHERS
    if not alone and share >= _LEAST_SHARE:
        return ""
    found = f"The mask leaves {100 * share:.1f} % of the measured pixels"
    if alone:
        found += (
            ", and a typical one of these in one pose alone: a pattern of the sensor cannot be "
            "distinguished from noise"
        )
    return (
        f"{found}. A mask made from the depth, as by RANSAC, leaves out the pixels with large "
        "errors: widen its threshold."
    )
