"""Where a set of pixels lies: at edges, in a part of the image, in some frames, at a distance."""

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from tofcorr.diagnosis.sums.observations import Observations
from tofcorr.diagnosis.sums.study import Study

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
