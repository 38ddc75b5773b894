"""Which pixels the base fit leaves out or weighs down as outliers: how many, how far off, where.

Gap and effects describe the other pixels. A camera whose errors are rare and large, such as flying
pixels at edges, has most of its error in pixels that are left out. So have masks that a plane fit
made from the depth: of a strong pattern of the sensor they leave few pixels, and what is left of it
looks like noise.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from tofcorr.diagnosis.sums.observations import Observations
from tofcorr.diagnosis.sums.study import Study
from tofcorr.geometry.rays import multiples_in_words, range_of_wrapped

# A group of pixels is crowded if its share of outliers exceeds that of all pixels this many times,
# and by so many pixels: above ten, chance alone does not triple a count. Chosen.
_CROWDED, _BY_CHANCE = 3.0, 10
# Tiles along each side of the image, groups of a covariate with equally many pixels, and the most
# frames that are listed. Chosen.
_GROUPS = 8
# Brightest over darkest pixel of a 3 x 3 neighbourhood that holds an edge of the target. Chosen:
# neighbours of one reflectivity differ by a few per cent and by noise.
_EDGE_RATIO = 1.5
# A warning is given from this share of outliers on. Normal noise makes 1 in 16 000 pixels one; 1 %
# of pixels that are off by 0.1 m hold an error of 10 mm RMS. Chosen.
_WORTH_A_WARNING = 0.01


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
        parts, reason = [], ""
        if self.wrapped_by is not None:
            range_ = multiples_in_words(self.wrapped_by)
            reason = f"(most by {range_}: they show a target beyond it) "
        if self.deleted:
            parts.append(
                f"{_percent(self.deleted)} of the pixels are off by {1e3 * self.size:.0f} mm RMS "
                f"{reason}and are left out as outliers"
            )
        if self.reduced:
            whose = "" if self.deleted else " of the pixels"
            parts.append(f"{_percent(self.reduced)}{whose} count less, as outliers")
        return (
            f"{'; '.join(parts)}. They lie {self.place}. "
            "Gap and effects describe the other pixels: mask these, or find out what they show."
        )


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %" if round(100 * share, 1) else "fewer than 0.1 %"


def outliers_of(study: Study, *, tiles: tuple[int, int] = (6, 8)) -> Outliers:
    """Count the pixels that the base fit leaves out or weighs down, and find where they lie.

    Args:
        study: The recording.
        tiles: Rows and columns of the map of outliers. Chosen: as in the map of the bias.
    """
    odd, deleted = study.fit.trust < 1, study.fit.trust == 0
    errors, wrapped_by = study.fit.residual[deleted], None
    if len(errors):
        frequency = study.observations.recording.modulation_frequency
        wrapped_by = range_of_wrapped(errors.numpy(), frequency)
    tile, (rows, columns) = _tiles(study.observations, *tiles), tiles
    held = torch.bincount(tile, odd.double(), rows * columns)
    return Outliers(
        deleted=float(deleted.double().mean()),
        reduced=float((odd & ~deleted).double().mean()),
        size=float(errors.square().mean().sqrt()) if len(errors) else 0.0,
        noise=study.fit.floor,
        tiles=(held / torch.bincount(tile, minlength=len(held))).reshape(tiles).numpy(),
        place=place_of(study, odd),
        wrapped_by=wrapped_by,
    )


def place_of(study: Study, chosen: Tensor, *, most_of_them: float = 0.5) -> str:
    """Return a clause that says where the chosen pixels (M,) lie.

    Args:
        study: The recording.
        chosen: Which pixels, shape (M,), bool.
        most_of_them: Crowded groups are reported if together they hold this share of the outliers.
            Chosen.
    """
    if not bool(chosen.any()):
        return "nowhere"
    found = [
        (float(there[chosen].double().mean()), float(there.double().mean()), words)
        for words, there in _places(study, chosen)
    ]
    held = [place for place in found if place[0] >= most_of_them]
    if not held:
        return "all over the images"
    share, _, words = max(held, key=lambda place: place[0] - place[1])
    return f"mostly {words} ({100 * share:.0f} % of them)"


def _places(study: Study, chosen: Tensor) -> Iterator[tuple[str, Tensor]]:
    """Yield a clause and the pixels, (M,), for each kind of place that is crowded."""
    observations = study.observations
    edges = {"at the rim of the target's mask": (observations.on_target, 1.0)}
    if observations.amplitude_images is not None:
        edges["at edges between dark and bright"] = observations.amplitude_images, _EDGE_RATIO
    for words, (images, ratio) in edges.items():
        there = _at_edges(observations, images, ratio)
        if _is_crowded(there, chosen):
            yield words, there
    width = observations.recording.camera.width
    row, column = observations.pixel // width, observations.pixel % width
    members = chosen & _crowded(_tiles(observations, _GROUPS, _GROUPS), chosen)
    if bool(members.any()):
        ends = [(int(x[members].min()), int(x[members].max())) for x in (row, column)]
        (top, bottom), (left, right) = ends
        there = (row >= top) & (row <= bottom) & (column >= left) & (column <= right)
        if _is_crowded(there, chosen):
            yield f"in rows {top} to {bottom} and columns {left} to {right}", there
    there = _crowded(observations.frame, chosen)
    numbers = observations.frame[there].unique().tolist()
    if numbers:
        words = f"in frame{'s' * (len(numbers) > 1)} {', '.join(map(str, numbers[:_GROUPS]))}"
        more = len(numbers) - _GROUPS
        yield words + f" and {more} more" * (more > 0), there
    values = {"at distances from {:.2f} to {:.2f} m": study.inputs.radial_distance}
    if observations.amplitude is not None:
        values["at amplitudes from {:.0f} to {:.0f}"] = observations.amplitude
    inner = torch.linspace(0, 1, _GROUPS + 1, dtype=torch.float64)[1:-1]
    for words, own in values.items():
        levels = torch.quantile(own[:: len(own) // 100_000 + 1], inner)
        there = _crowded(torch.bucketize(own, levels), chosen)
        if bool(there.any()):
            yield words.format(float(own[there].min()), float(own[there].max())), there


def _tiles(observations: Observations, rows: int, columns: int) -> Tensor:
    """Return the tile of the image that each pixel lies in, shape (M,)."""
    camera, pixel = observations.recording.camera, observations.pixel
    row, column = pixel // camera.width, pixel % camera.width
    return row * rows // camera.height * columns + column * columns // camera.width


def _at_edges(observations: Observations, images: Tensor, ratio: float) -> Tensor:
    """Return which pixels (M,) lie where images (F, H, W) change by more than a ratio.

    The largest over the smallest value in 3 x 3 pixels counts; a mask has no edge outside it.
    """
    found = []
    for frame, (start, end) in enumerate(observations.frame_ends):
        image = images[frame][None].float()
        high, low = max_pool2d(image, 3, 1, 1)[0], -max_pool2d(-image, 3, 1, 1)[0]
        near = (high / low.clamp(min=1e-3 * high)).nan_to_num(1.0)
        near = torch.where(observations.on_target[frame], near, 1.0)
        found.append(near.flatten()[observations.pixel[start:end]] > ratio)
    return torch.cat(found)


def _is_crowded(there: Tensor, chosen: Tensor) -> bool:
    return float(chosen[there].double().sum()) > _CROWDED * float(
        chosen.double().mean() * there.sum()
    )


def _crowded(group: Tensor, chosen: Tensor) -> Tensor:
    """Return which pixels lie in groups with many chosen ones, shape (M,)."""
    expected = torch.bincount(group) * chosen.double().mean()
    return (torch.bincount(group, chosen.double()) > _CROWDED * expected + _BY_CHANCE)[group]


def mask_warning(observations: Observations, *, least_share: float = 0.02) -> str:
    """Return a sentence or two for people; empty without a mask, or if it leaves enough.

    A pixel that less than one other pose shows, on average, cannot show a pattern: what two poses
    agree in is a pattern; one pose has nothing to agree with.

    Args:
        observations: The pixels.
        least_share: A mask that leaves less than this share of the measured pixels is worth a
            warning. Chosen: a board that fills a seventh of the image in width and height.
    """
    if observations.recording.mask is None:
        return ""
    seen, measured = observations.usable, observations.distance_images > 0
    share = float(seen.sum() / measured.sum().clamp(min=1))
    units = [seen[observations.unit == unit].any(0) for unit in range(observations.num_units)]
    poses = torch.stack(units).sum(0)
    alone = float((poses * (poses - 1)).sum() / poses.sum().clamp(min=1)) < 1
    if not alone and share >= least_share:
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
